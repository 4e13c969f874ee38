"""The command line: help that teaches, one-line errors, exit statuses, and the verbs against the real service."""

import argparse
import json
import os
import re
import signal
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from rsavatar import cli_local
from rsavatar.cli import main
from rsavatar.cli_progress import Display, print_means
from rsavatar.cli_request import parse_setting, read_request
from rsavatar.errors import SpecError
from rsavatar.events import Note, Progress, to_json
from rsavatar.spec import resolve
from tests.core.live_service import Service, live_service

VERBS = [
    "run",
    "bench",
    "data check",
    "data studio",
    "data build-rs",
    "data build-zju",
    "data convert",
    "restore train",
    "restore pack",
    "restore score",
    "submit",
    "watch",
    "jobs",
    "table",
    "cancel",
    "retry",
    "subjects",
    "grid",
]


def test_help_is_instant_because_nothing_heavy_is_imported() -> None:
    heavy = "{'torch', 'numpy', 'pydantic', 'httpx', 'rich', 'cv2', 'rsavatar.spec'}"
    code = f"import rsavatar.cli, sys; print(sorted({heavy} & set(sys.modules)))"
    assert subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True).stdout == "[]\n"


@pytest.mark.parametrize("verb", ["", *VERBS])
def test_every_verb_explains_itself(verb: str, capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as left:
        main([*verb.split(), "--help"])
    assert left.value.code == 0
    text = capsys.readouterr().out
    assert f"usage: rsavatar {verb}".strip() in text
    assert max(map(len, text.splitlines())) <= 120


@pytest.mark.parametrize(
    "verb", ["", "run", "submit", "grid", "data check", "data studio", "data build-rs", "data convert"]
)
def test_help_teaches_by_examples_that_parse(verb: str, capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit):
        main([*verb.split(), "--help"])
    commands = re.findall(r"^  rsavatar (\S.*?)(?:   .*)?$", capsys.readouterr().out, re.MULTILINE)
    assert commands
    for command in commands:
        with pytest.raises(SystemExit) as left:
            main([*command.split(), "--help"])
        assert left.value.code == 0, command


@pytest.mark.parametrize(
    ("setting", "path", "value"),
    [
        ("method=rs-avatar", ["method"], "rs-avatar"),
        ("T=11", ["T"], 11),
        ("T=2K", ["T"], "2K"),
        ("lambda=0.5", ["lambda"], 0.5),
        ("densify=false", ["densify"], False),
        ("ablation.no_rs=true", ["ablation", "no_rs"], True),
        ("ablation={no_rs=true}", ["ablation"], {"no_rs": True}),
        ('body="a=b.npz"', ["body"], "a=b.npz"),
        ("body=models/smpl.npz", ["body"], "models/smpl.npz"),
        ("subject=", ["subject"], ""),
    ],
)
def test_a_setting_is_a_toml_value_or_the_text_itself(setting: str, path: list[str], value: object) -> None:
    assert parse_setting(setting) == (path, value)


@pytest.mark.parametrize("setting", ["method", "=3", "a..b=1", ".a=1"])
def test_a_malformed_setting_is_refused(setting: str) -> None:
    with pytest.raises(SpecError, match="--set: expected KEY=VALUE"):
        parse_setting(setting)


def test_a_file_is_overlaid_by_settings(tmp_path: Path) -> None:
    path = tmp_path / "job.toml"
    path.write_text('preset = "smoke"\nmethod = "rs-avatar"\nsubject = "wave"\n[ablation]\nno_reg = true\n')
    request = read_request(str(path), ["ablation.no_rs=true", "seed=3"])
    assert request == {
        "preset": "smoke", "method": "rs-avatar", "subject": "wave", "seed": 3,
        "ablation": {"no_reg": True, "no_rs": True},
    }  # fmt: skip
    assert resolve(request).ablation.flags() == ("no_rs", "no_reg")


def test_the_folder_names_a_subject_that_is_named_nowhere(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "wave").mkdir()
    monkeypatch.chdir(tmp_path / "wave")
    assert read_request("draft", ["method=gauhuman"], Path())["subject"] == "wave"
    assert read_request("draft", ["method=gauhuman", "subject=walk"], Path())["subject"] == "walk"


@pytest.mark.parametrize(
    ("arguments", "sentence"),
    [
        (["run", "nothing.toml"], "SPEC: expected a TOML file or one of draft, paper, smoke, got 'nothing.toml'"),
        (
            ["run", "draft"],
            "method: expected one of rs-avatar, gauhuman, cvr+gauhuman, jamnet+gauhuman",
        ),
        (["run", "draft", "--set", "method=gauhuman"], "subject: expected a name, got nothing; say --set subject=..."),
        (["run", "draft", "--set", "method=x", "--set", "subject=a"], "method: expected one of"),
        (["run", "draft", "--set", "T.a=1", "--set", "T.a.b=1"], "--set T.a.b=1: expected a to hold words of its own"),
        (["submit", "draft"], "method: expected one of"),
        (["jobs", "--url", "http://127.0.0.1:1"], "cannot reach http://127.0.0.1:1: is `make up` running?"),
        (["table", "main", "--url", "localhost"], "not an address: 'localhost'"),
        (["data", "check", "/nowhere/at/all"], "DIR: expected a folder, got '/nowhere/at/all'"),
    ],
)
def test_an_error_is_one_line_and_status_2(
    arguments: list[str], sentence: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(arguments) == 2
    said = capsys.readouterr()
    assert said.err.startswith(f"error: {sentence}")
    assert said.err.count("\n") == 1
    assert said.out == ""


def test_a_broken_file_is_named(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "job.toml").write_text("method = rs avatar")
    assert main(["run", str(tmp_path / "job.toml")]) == 2
    assert f"error: {tmp_path / 'job.toml'}: expected a TOML file" in capsys.readouterr().err


def test_debug_shows_the_traceback() -> None:
    with pytest.raises(SpecError):
        main(["run", "nothing.toml", "--debug"])


def test_a_studio_subject_is_made_where_asked(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    words = ["data", "studio", str(tmp_path / "tiny"), "--size", "24", "--frames", "1", "--gamma", "0"]
    assert main(words) == 0
    assert capsys.readouterr().out == f"{tmp_path / 'tiny'}\n"
    assert (tmp_path / "tiny" / "meta.json").is_file()
    assert main([*words[:3], "--frames", "0"]) == 2


def test_an_absent_benchmark_is_said_plainly() -> None:
    with pytest.raises(SpecError, match="bench nothing: not available in this version"):
        cli_local.bench(argparse.Namespace(name="nothing", json=None))


def test_the_first_signal_asks_and_the_second_is_as_ever() -> None:
    found = signal.signal(signal.SIGINT, signal.default_int_handler)  # a shell's background jobs ignore SIGINT
    try:
        with cli_local.stop_on_signal() as stop:
            assert not stop.is_set()
            os.kill(os.getpid(), signal.SIGINT)
            assert stop.wait(1)
            with pytest.raises(KeyboardInterrupt):
                signal.raise_signal(signal.SIGINT)
        assert signal.getsignal(signal.SIGINT) is signal.default_int_handler
        assert signal.getsignal(signal.SIGTERM) is signal.SIG_DFL
    finally:
        signal.signal(signal.SIGINT, found)


def test_progress_without_a_terminal_is_lines(capsys: pytest.CaptureFixture[str]) -> None:
    with Display() as display:
        display.show(to_json(Note("the body is [anny]")))
        display.show(to_json(Progress("train", 30, 60, 3.0, loss=0.12345, gaussians=7000)))
        display.show(to_json(Progress("train", 31, 60, 3.1)))
        display.show(to_json(Progress("train", 60, 60, 6.0)))
    assert capsys.readouterr().err.splitlines() == [
        "the body is [anny]",
        "train 30/60 loss 0.1235  gaussians 7000  3 s left",
        "train 60/60 ",
    ]


def test_a_mean_that_is_absent_says_why(capsys: pytest.CaptureFixture[str]) -> None:
    print_means("title", {"psnr": 23.456, "ssim": 0.81234, "lpips": None}, {"lpips": "weights absent (set X)"})
    text = capsys.readouterr().out
    assert "23.46" in text
    assert "0.8123" in text
    assert "weights absent (set X)" in text


@pytest.fixture(scope="module")
def service(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Service]:
    with live_service(tmp_path_factory.mktemp("home")) as running:
        yield running


@pytest.fixture
def say(service: Service, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> Any:
    """Run a command against the service: (exit status, what it printed)."""
    monkeypatch.setenv("RSAVATAR_URL", service.url)

    def run(*arguments: str) -> tuple[int, str]:
        status = main(arguments)
        return status, capsys.readouterr().out

    return run


def test_the_verbs_of_the_service_end_to_end(service: Service, say: Any, tmp_path: Path) -> None:
    status, printed = say("submit", "smoke", "--set", "method=gauhuman", "--set", "subject=studio", "--key", "k")
    job_id = printed.strip()
    assert status == 0
    assert re.fullmatch(r"[0-9a-f-]{36}", job_id)
    assert say("submit", "smoke", "--set", "method=gauhuman", "--set", "subject=studio", "--key", "k")[1] == printed
    assert f"{job_id}  queued" in say("jobs", "--state", "queued")[1]
    assert say("cancel", job_id)[1].startswith(f"{job_id}  cancelled")
    assert say("watch", job_id) == (1, "")
    assert say("retry", job_id)[1].startswith(f"{job_id}  queued")

    service.succeed(service.claim(), psnr=23.456)
    status, printed = say("watch", job_id)
    assert status == 0
    assert "23.46" in printed
    assert "weights absent" in printed
    assert "| GauHuman | 23.46 |" in say("table", "main")[1]
    assert json.loads(say("table", "per-subject", "--format", "json")[1])["rows"][0]["method"] == "gauhuman"

    known = say("submit", "smoke", "--set", "method=gauhuman", "--set", "subject=studio")[1].strip()
    forced = say("submit", "smoke", "--set", "method=gauhuman", "--set", "subject=studio", "--force")[1].strip()
    assert f"{known}  succeeded" in say("jobs")[1]
    assert f"{forced}  queued" in say("jobs")[1]
    say("cancel", forced)


def test_a_failed_job_is_listed_with_its_reason(service: Service, say: Any) -> None:
    job_id = say("submit", "smoke", "--set", "method=mad-avatar", "--set", "subject=studio")[1].strip()
    service.fail(service.claim())
    assert say("watch", job_id)[0] == 1
    assert "mask: expected a picture, got nothing" in say("jobs", "--method", "mad-avatar", "--limit", "1")[1]


def test_subjects_are_made_known(say: Any, tmp_path: Path) -> None:
    (tmp_path / "annots.npy").touch()
    status, printed = say("subjects", "--add", "mine", str(tmp_path))
    assert status == 0
    assert re.search(r"^studio +ready +built in$", printed, re.MULTILINE)
    assert re.search(rf"^mine +ready +{re.escape(str(tmp_path))}$", printed, re.MULTILINE)


def test_a_reader_that_stops_reading_is_no_error(service: Service) -> None:
    command = f"{sys.executable} -m rsavatar.cli jobs --url {service.url} | true"
    done = subprocess.run(["bash", "-c", command], capture_output=True, text=True, check=True)
    assert done.stderr == ""
