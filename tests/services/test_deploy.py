"""The deployment files are parsed, not run by a container engine: their commands, settings and limits are those that
exist. The scripts in them are run.
"""

from __future__ import annotations

import importlib.util
import json
import os
import re
import shutil
import subprocess
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
import redis
import yaml

from services import jobs, redis_server
from services.api.limits import Limiter, Pace
from services.demo import free_port
from services.process import stop
from services.settings import Settings, read_settings
from tests.system.harness import until

ROOT = Path(__file__).resolve().parents[2]
COMPOSE: dict[str, Any] = yaml.safe_load((ROOT / "docker-compose.yml").read_text("utf-8"))
DOCKERFILE = (ROOT / "deploy" / "docker" / "Dockerfile").read_text("utf-8")
OURS = ("migrate", "api", "worker", "backup")
DEPLOY = ROOT / "deploy"
SECRETS = {
    "database_url": "postgresql+psycopg://rsavatar:word@postgres/rsavatar",
    "broker_url": "redis://:word@redis:6379/0",
}


def has_entry(module: str) -> bool:
    found = importlib.util.find_spec(module)
    if found is not None and found.submodule_search_locations:
        return importlib.util.find_spec(f"{module}.__main__") is not None
    return found is not None


@pytest.mark.parametrize("name", OURS)
def test_commands_exist(name: str) -> None:
    service = COMPOSE["services"][name]
    if name == "backup":
        assert (ROOT / service["command"][1]).is_file()
    else:
        assert service["command"][:2] == ["python", "-m"]
        assert has_entry(service["command"][2])
    assert f"FROM base AS {service['build']['target']}\n" in DOCKERFILE
    assert (ROOT / service["build"]["dockerfile"]).is_file()


def settings_of(environment: dict[str, str], monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> Settings:
    """What the service reads in a container with this environment and the secrets."""
    ours = {key: value for key, value in environment.items() if key.startswith("RSAVATAR_")}
    known = {f"RSAVATAR_{field.upper()}" for field in Settings.model_fields}
    assert {key.removesuffix("_FILE") for key in ours} <= known
    for key, value in ours.items():
        if key.endswith("_FILE"):
            file = tmp_path / value.rpartition("/")[2]
            file.write_text(SECRETS[file.name] + "\n")
        monkeypatch.setenv(key, str(file) if key.endswith("_FILE") else str(value))
    return read_settings()


@pytest.mark.parametrize("name", OURS)
def test_settings_exist_and_are_valid(name: str, monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    settings = settings_of(COMPOSE["services"][name]["environment"], monkeypatch, tmp_path)
    assert settings.broker == SECRETS["broker_url"]
    assert settings.database == SECRETS["database_url"]
    assert settings.needs_token or name != "api"


@pytest.mark.parametrize("name", OURS)
def test_our_containers_may_do_little(name: str) -> None:
    service = COMPOSE["services"][name]
    assert service["read_only"] is True
    assert service["cap_drop"] == ["ALL"]
    assert service["user"] == "10001:10001"
    assert service["security_opt"] == ["no-new-privileges:true"]


@pytest.mark.parametrize("name", list(COMPOSE["services"]))
def test_everything_is_limited_and_watched(name: str) -> None:
    service = COMPOSE["services"][name]
    assert set(service["deploy"]["resources"]["limits"]) == {"cpus", "memory"}
    assert "healthcheck" in service or name in {"migrate", "backup"}
    assert service["read_only"] is True
    assert "no-new-privileges:true" in service["security_opt"]
    assert service["logging"]["options"] == {"max-size": "10m", "max-file": "3"}
    assert set(service.get("secrets", [])) <= set(COMPOSE["secrets"])
    for other, how in service.get("depends_on", {}).items():
        once = how["condition"] == "service_completed_successfully"
        assert once if other == "migrate" else "healthcheck" in COMPOSE["services"][other]


def test_only_the_api_is_published_and_only_on_loopback() -> None:
    published = {name: s["ports"] for name, s in COMPOSE["services"].items() if "ports" in s}
    assert {port.rpartition(":")[0].partition(":")[0] for ports in published.values() for port in ports} == {
        "127.0.0.1"
    }
    assert {name for name in published if "profiles" not in COMPOSE["services"][name]} == {"api"}
    assert COMPOSE["networks"]["inside"] == {"internal": True}


def test_a_worker_has_time_for_its_checkpoint() -> None:
    worker = COMPOSE["services"]["worker"]
    grace = int(worker["environment"]["RSAVATAR_GRACE_SECONDS"])
    assert int(worker["stop_grace_period"].rstrip("s")) > grace + 20
    limit = int(worker["deploy"]["resources"]["limits"]["memory"].rstrip("g")) << 10
    assert int(worker["environment"]["RSAVATAR_MEMORY_LIMIT_MB"]) < limit


def test_images_run_as_nobody_and_the_api_has_no_torch() -> None:
    for target in ("api", "worker", "backup"):
        stage = re.split(r"^FROM ", DOCKERFILE, flags=re.MULTILINE)
        (body,) = (s for s in stage if s.startswith(f"base AS {target}\n"))
        assert "USER 10001:10001" in body
    (api,) = (s for s in re.split(r"^FROM ", DOCKERFILE, flags=re.MULTILINE) if s.startswith("build AS build-api"))
    assert ".[api]" in api
    assert "worker" not in api
    assert "core" not in api


def test_no_secret_is_in_an_environment_or_a_command() -> None:
    text = (ROOT / "docker-compose.yml").read_text("utf-8")
    assert "PASSWORD:" not in text
    assert not re.search(r"://[^/\s]*:[^/\s]*@", text)
    assert "deploy/secrets" in (ROOT / ".dockerignore").read_text("utf-8")
    assert "/deploy/secrets/" in (ROOT / ".gitignore").read_text("utf-8")


def make_secrets(folder: Path) -> dict[str, str]:
    subprocess.run(["sh", str(folder / "secrets.sh")], check=True, capture_output=True)
    return {path.name: path.read_text().strip() for path in (folder / "secrets").iterdir()}


def test_the_secrets_are_made_once_and_fit_together(tmp_path: Path) -> None:
    shutil.copy(DEPLOY / "secrets.sh", tmp_path)
    first, made = make_secrets(tmp_path), make_secrets(tmp_path)
    assert made == first
    assert set(made) == set(COMPOSE["secrets"])
    assert len(made["postgres_password"]) == len(made["redis_password"]) == 40
    assert f":{made['postgres_password']}@postgres/" in made["database_url"]
    assert made["broker_url"] == f"redis://:{made['redis_password']}@redis:6379/0"
    assert (tmp_path / "secrets").stat().st_mode & 0o777 == 0o700


@pytest.fixture
def guarded(tmp_path: Path) -> Iterator[str]:
    """The URL of a Redis that the deployment's script has started."""
    (tmp_path / "word").write_text("s3cret\n")
    server = str(redis_server.find_server(Settings(home=tmp_path)))
    env = os.environ | {"REDIS_PASSWORD_FILE": str(tmp_path / "word"), "REDIS_SERVER": server}
    port = free_port()
    command = ["sh", str(DEPLOY / "docker" / "redis.sh"), "--port", str(port), "--bind", "127.0.0.1"]
    process = subprocess.Popen(command, env=env, cwd=tmp_path, stdout=subprocess.DEVNULL)
    url = f"redis://:s3cret@127.0.0.1:{port}/0"
    try:
        with redis.Redis.from_url(url) as client:
            until(lambda: answers(client))
        yield url
    finally:
        stop(process, 5.0)


def answers(client: redis.Redis) -> bool:
    try:
        return bool(client.ping())
    except redis.ConnectionError:
        return False


def test_redis_lets_us_work_and_nobody_rule(guarded: str, tmp_path: Path) -> None:
    settings = Settings(home=tmp_path, broker_url=guarded)
    app = jobs.make_app(settings)
    assert jobs.enqueue(app, "00000000-0000-7000-8000-000000000000")
    assert jobs.backlog(app) == 1
    limiter = Limiter(settings)
    assert [limiter.wait("x", Pace(0.01, 2.0)) > 0 for _ in range(3)] == [False, False, True]
    limiter.close()
    app.close()
    with redis.Redis.from_url(guarded) as client:
        assert client.exists("rsavatar:limit:x")
        for order in ("FLUSHALL", "CONFIG GET dir", "SHUTDOWN", "KEYS *", "MODULE LIST"):
            with pytest.raises(redis.exceptions.NoPermissionError):
                client.execute_command(*order.split())
        with pytest.raises(redis.exceptions.NoPermissionError):
            client.set("other", "1")
    with redis.Redis.from_url(guarded.replace("s3cret", "wrong")) as stranger, pytest.raises(redis.AuthenticationError):
        stranger.ping()


def documents(overlay: str) -> list[dict[str, Any]]:
    """The objects of a Kustomize overlay; without kubectl those of the base as they stand."""
    place = DEPLOY / "k8s" / "overlays" / overlay
    if shutil.which("kubectl"):
        done = subprocess.run(["kubectl", "kustomize", str(place)], capture_output=True, text=True, check=False)
        assert done.returncode == 0, done.stderr
        return list(yaml.safe_load_all(done.stdout))
    base = yaml.safe_load((DEPLOY / "k8s" / "base" / "kustomization.yaml").read_text("utf-8"))
    texts = [(DEPLOY / "k8s" / "base" / name).read_text("utf-8") for name in base["resources"]]
    return [document for text in texts for document in yaml.safe_load_all(text)]


@pytest.mark.parametrize("overlay", ["single-node", "ha"])
def test_the_cluster_runs_the_same_programs_with_the_same_limits(
    overlay: str, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    found = {(each["kind"], each["metadata"]["name"]): each for each in documents(overlay)}
    shared = next(each["data"] for (kind, name), each in found.items() if kind == "ConfigMap" and name == "settings")
    for kind, name in (("Deployment", "api"), ("Deployment", "worker"), ("Job", "migrate")):
        pod = found[kind, name]["spec"]["template"]["spec"]
        (container,) = (each for each in pod["containers"] if each["name"] != "renderer")
        composed = COMPOSE["services"][name]
        assert container["command"] == composed["command"]
        assert pod["securityContext"]["runAsUser"] == 10001
        own = {each["name"]: each["value"] for each in container.get("env", [])}
        with monkeypatch.context() as patch:
            settings = settings_of(shared | own, patch, tmp_path)
        assert settings.needs_token or name != "api"
        grace = pod.get("terminationGracePeriodSeconds", 30)
        assert name != "worker" or grace > settings.grace_seconds + 20
        drawing = [*COMPOSE["services"]["renderer"]["command"][:-1], str(settings.render_socket)]
        beside = [each["command"] for each in pod["containers"] if each["name"] == "renderer"]
        assert beside == ([drawing] if name == "api" else [])


@pytest.mark.parametrize("overlay", ["single-node", "ha"])
def test_pods_may_do_little_and_are_watched(overlay: str) -> None:
    for each in documents(overlay):
        if each["kind"] not in {"Deployment", "StatefulSet", "Job"}:
            continue
        pod = each["spec"]["template"]["spec"]
        assert pod["automountServiceAccountToken"] is False
        assert pod["securityContext"]["runAsNonRoot"] is True
        for container in pod["containers"]:
            rights = container["securityContext"]
            assert (rights["allowPrivilegeEscalation"], rights["readOnlyRootFilesystem"]) == (False, True)
            assert rights["capabilities"] == {"drop": ["ALL"]}
            assert set(container["resources"]["limits"]) == {"cpu", "memory"}
            assert "livenessProbe" in container or each["kind"] == "Job"


def test_one_script_starts_redis_everywhere() -> None:
    scripts = [path.read_bytes() for path in (DEPLOY / "docker" / "redis.sh", DEPLOY / "k8s" / "base" / "redis.sh")]
    assert scripts[0] == scripts[1]


def test_what_is_watched_exists(client: Any) -> None:
    client.get("/api/v1/jobs")
    measured = set(re.findall(r"^(rsavatar_\w+)", client.get("/metrics").text, re.MULTILINE))
    board = (DEPLOY / "observability" / "grafana" / "dashboards" / "rsavatar.json").read_text("utf-8")
    rules = yaml.safe_load((DEPLOY / "observability" / "alerts.yml").read_text("utf-8"))["groups"][0]["rules"]
    asked = set(re.findall(r"rsavatar_\w+", board + " ".join(rule["expr"] for rule in rules)))
    assert asked <= measured
    assert len({panel["id"] for panel in json.loads(board)["panels"]}) == len(json.loads(board)["panels"])
    assert all(rule["annotations"]["summary"] for rule in rules)
    scrape = yaml.safe_load((DEPLOY / "observability" / "prometheus.yml").read_text("utf-8"))["scrape_configs"][0]
    assert client.get(scrape["metrics_path"]).status_code == 200


@pytest.mark.parametrize("script", sorted(str(path.relative_to(DEPLOY)) for path in DEPLOY.rglob("*.sh")))
def test_scripts_are_plain_shell(script: str) -> None:
    subprocess.run(["sh", "-n", str(DEPLOY / script)], check=True)
