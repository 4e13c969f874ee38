"""The command line. This file knows the words; the verbs, and what is heavy, are imported when they are said."""

from __future__ import annotations

import argparse
import importlib
import os
import sys
from collections.abc import Callable, Sequence
from pathlib import Path

from rsavatar import __version__, cli_data, cli_restore
from rsavatar.catalog import STUDIES
from rsavatar.errors import RsAvatarError

EXIT_BAD, EXIT_STOPPED = 2, 130  # a named error; interrupted from the keyboard

MAIN = """\
examples:
  rsavatar run smoke --set method=rs-avatar --set subject=studio     seconds, on a subject that is made on the spot
  rsavatar run draft --set method=gauhuman --subject-dir data/wave   minutes, on your subject
  rsavatar data check data/wave                                      is the subject fit for training?
  rsavatar submit draft --set method=rs-avatar --set subject=wave    the same through the service (`make up`)
  rsavatar table main --format tex                                   the results, for the paper

`rsavatar VERB --help` explains a verb.
"""
RUN = """\
SPEC is a TOML file or the name of a preset (smoke, draft, paper). A file holds the words of a job:

  preset = "draft"        # values that are not named come from here
  method = "rs-avatar"    # rs-avatar | gauhuman | mad-avatar
  T = "scanline"          # row bands: a number, "K", "2K", or "scanline"

examples:
  rsavatar run job.toml --subject-dir data/wave --out runs/wave
  rsavatar run paper --set method=mad-avatar --set T=11 --subject-dir data/wave
  rsavatar run draft --set method=rs-avatar --set ablation.no_rs=true --set seed=1 --subject-dir data/wave

Ctrl-C stops at the next step and writes a checkpoint; the same command goes on from it, to the same numbers.
OUT holds checkpoint.safetensors, metrics.json, motion.npz and predictions/<camera>/<frame>.png.
"""
SUBMIT = """\
examples:
  rsavatar submit draft --set method=rs-avatar --set subject=wave
  rsavatar submit job.toml --key wave-seed-0 --watch        the same key never makes a second job

Prints the job's id. SPEC and --set are those of `rsavatar run`.
"""
GRID = """\
A grid varies a base request along axes. Without GRID, lists the built-in grids and the service's newest. A list after
--set makes an axis. A file looks like those in core/experiments/grids:

  [base]
  preset = "draft"
  method = "rs-avatar"
  [axes]
  subject = ["sword", "walk"]
  ablation = ["full", "no_rs", "no_spline"]

examples:
  rsavatar grid ablation --subjects sword --set preset=draft --dry-run
  rsavatar grid ablation --subjects sword --set preset=draft --watch
  rsavatar grid main --subjects sword,walk,wave --set seed=[0,1,2]
  rsavatar table ablation --grid ID --format tex
"""
CHECK = """\
Reads files, cameras, timing and masks, projects the fitted body into sampled masks, and names the usual mistakes:
metres for millimetres, Rh taken for global_orient, files that are missing. Exit status 1 when unfit.

example:
  rsavatar data check data/CoreView_377
"""
LOGIN = """\
Reads a token (from the terminal, or the first line of standard input), tries it, and keeps it in
~/.config/rsavatar/tokens.json for this address. RSAVATAR_TOKEN in the environment goes before what is kept.

example:
  rsavatar login --url https://lab.example < admin-token
"""
TOKEN = """\
Prints the token, which is shown this once. `submit` covers `read`, and `admin` covers both.

examples:
  rsavatar token create laptop --owner ann
  rsavatar token create dashboards --owner monitoring --scope read --days 0
"""
OWNER = """\
What is not named is as the service has it for everybody. An owner of share 2 gets twice the workers of one of share 1
while both have work.

example:
  rsavatar owner set ann --queued 200 --running 4 --share 2
"""
FIGURE = """\
The service draws it from its database and its avatars; the file's ending says the format.

examples:
  rsavatar figure per-subject --out per-subject.pdf
  rsavatar figure qualitative --subject walk --camera 07 --frame 5 --out walk.png
  rsavatar figure curves --out curves.json                     the numbers, and the jobs they come from
"""
EXPORT = """\
The file's ending says what it is to be: .ply is the Gaussians (canonical, or posed with --time) in the layout of 3D
Gaussian splatting, .png and .webp a view, .mp4, .webm and .gif a turntable.

examples:
  rsavatar export runs/studio-rs-avatar-1a2b3c4d --out avatar.ply
  rsavatar export ID --time 3.5 --shutter rolling --azimuth 30 --out view.png
  rsavatar export ID --out turntable.mp4
"""
WATCH = (
    "Follows a job's progress and prints its results. A broken connection is taken up again. Ctrl-C only stops looking."
)


def main(argv: Sequence[str] | None = None) -> int:
    """Run one verb. Returns the exit status: 0 done, 1 done with a bad answer, 2 an error, 130 interrupted."""
    arguments = _parser().parse_args(argv)
    module, _, name = str(arguments.verb).partition(":")
    try:
        verb: Callable[[argparse.Namespace], int] = getattr(importlib.import_module(module), name)
        return verb(arguments)
    except RsAvatarError as error:
        if arguments.debug:
            raise
        return _fail(str(error))
    except ModuleNotFoundError as error:
        if arguments.debug or str(error.name).startswith("rsavatar"):
            raise
        return _fail(f"{error.name} is not installed: pip install 'rsavatar[core,client]'")
    except KeyboardInterrupt:
        return EXIT_STOPPED
    except BrokenPipeError:  # the reader, such as `head`, has seen enough
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return EXIT_STOPPED


def _fail(sentence: str) -> int:
    print(f"error: {sentence}", file=sys.stderr)
    return EXIT_BAD


def _parser() -> argparse.ArgumentParser:
    about = "Animatable 3D Gaussian avatars from rolling-shutter video."
    parser = argparse.ArgumentParser("rsavatar", description=about, epilog=MAIN, formatter_class=_Layout)
    parser.add_argument("--version", action="version", version=f"rsavatar {__version__}")
    parser.set_defaults(debug=False)
    verbs = parser.add_subparsers(required=True, metavar="VERB", title="verbs")
    _add_local(verbs)
    _add_remote(verbs)
    return parser


def _add_local(verbs: argparse._SubParsersAction[argparse.ArgumentParser]) -> None:
    run = _add(verbs, "run", "rsavatar.cli_local:run", "reconstruct one subject on this machine", RUN)
    _add_request(run)
    run.add_argument("--subject-dir", type=Path, metavar="DIR", help="the subject's folder; its name names the subject")
    run.add_argument("--out", type=Path, metavar="DIR", help="where to write (default: runs/SUBJECT-METHOD-HASH)")

    bench = _add(verbs, "bench", "rsavatar.cli_local:bench", "measure speed or stability on this machine")
    names = ["render", "growth", "train", "stability", "builder", *STUDIES]
    bench.add_argument("name", metavar="NAME", choices=names, help=", ".join(names))
    bench.add_argument("--json", type=Path, metavar="FILE", help="write the figures here as well")
    studies = bench.add_argument_group("of " + ", ".join(STUDIES), "many jobs; one that was cut goes on with --json")
    where = "folders, studio-N, studio-N-exposed (also of train)"
    studies.add_argument("--subjects", nargs="+", default=[], metavar="DIR", help=where)
    studies.add_argument("--preset", default="draft", help="also of train (default: draft)")
    studies.add_argument("--seeds", type=int, default=1, metavar="N", help="seeds 0 to N - 1 (default: 1)")
    studies.add_argument("--jobs", type=int, default=1, metavar="N", help="processes at a time (default: 1)")

    nouns = verbs.add_parser("data", help="look at or make subjects").add_subparsers(required=True, metavar="VERB")
    check = _add(nouns, "check", "rsavatar.cli_local:check", "is a subject fit for training?", CHECK)
    check.add_argument("directory", type=Path, metavar="DIR")
    check.add_argument("--body", default="auto", help="auto, anny, or an SMPL-format .npz or .pkl (default: auto)")
    check.add_argument("--json", action="store_true", help="the findings as one line of JSON")
    cli_data.add_verbs(nouns, _add)
    correctors = verbs.add_parser("restore", help="train and score rolling-shutter correctors")
    cli_restore.add_verbs(correctors.add_subparsers(required=True, metavar="VERB"), _add)


def _add_remote(verbs: argparse._SubParsersAction[argparse.ArgumentParser]) -> None:
    submit = _add(verbs, "submit", "rsavatar.cli_remote:submit", "queue a job", SUBMIT)
    _add_request(submit)
    submit.add_argument("--key", help="idempotency key (default: a fresh one)")
    submit.add_argument("--force", action="store_true", help="run it even if its result is known")
    submit.add_argument("--watch", action="store_true", help="stay and follow it")

    _add_id(_add(verbs, "watch", "rsavatar.cli_remote:watch", "follow a job until it ends", WATCH))
    _add_id(_add(verbs, "cancel", "rsavatar.cli_remote:cancel", "stop a job"))
    _add_id(_add(verbs, "retry", "rsavatar.cli_remote:retry", "queue a failed or cancelled job again"))

    jobs = _add(verbs, "jobs", "rsavatar.cli_remote:jobs", "list jobs, newest first")
    for name in ("state", "method", "subject"):
        jobs.add_argument(f"--{name}")
    jobs.add_argument("-q", metavar="FILTER", help="such as 'state:failed,dead psnr>25 (tag:paper or created<2d)'")
    jobs.add_argument("--sort", metavar="KEY", help="submitted, psnr, seconds, ...; with - before it, largest first")
    jobs.add_argument("--limit", type=int, default=50, metavar="N", help="at most N jobs (default: 50)")

    table = _add(verbs, "table", "rsavatar.cli_remote:table", "print a table of results")
    table.add_argument("name", metavar="NAME", help="main, ablation, per-subject, shutter or cost")
    table.add_argument("--format", choices=["json", "csv", "md", "tex"], default="md", help="default: md")
    table.add_argument("--grid", metavar="ID", help="of the jobs of one grid")
    table.add_argument("--preset", help="of the jobs of one preset")
    table.add_argument("--tag", help="of the jobs with one tag")
    table.add_argument("--seed", action="append", metavar="N", help="of the jobs with one seed; repeatable")
    table.add_argument("-q", metavar="FILTER", help="of the jobs that a filter finds, as of `rsavatar jobs -q`")

    subjects = _add(verbs, "subjects", "rsavatar.cli_remote:subjects", "list subjects, or make one known")
    subjects.add_argument("--add", nargs=2, metavar=("NAME", "PATH"), help="a folder on the service's machine")
    subjects.add_argument("--upload", nargs=2, metavar=("NAME", "FILE"), help="a .zip or .tar.gz of yours")
    subjects.add_argument("--remove", metavar="NAME", help="forget a subject; an uploaded one's files are removed")
    access = (*_add_access(verbs), *_add_pictures(verbs), _add_grid(verbs))
    for parser in (submit, jobs, table, subjects, *access, *(verbs.choices[n] for n in ("watch", "cancel", "retry"))):
        parser.add_argument("--url", help="the service (default: $RSAVATAR_URL, else http://127.0.0.1:8000)")


def _add_pictures(verbs: argparse._SubParsersAction[argparse.ArgumentParser]) -> list[argparse.ArgumentParser]:
    figure = _add(verbs, "figure", "rsavatar.cli_pictures:figure", "draw a figure of the results", FIGURE)
    figure.add_argument("name", metavar="NAME", help="qualitative, per-subject, shutter, pareto, curves or ablation")
    figure.add_argument("--out", type=Path, required=True, metavar="FILE", help="NAME.png, .svg, .pdf or .json")
    figure.add_argument("--preset", help="of the jobs of one preset (default: the one that most jobs have)")
    for name in ("subject", "camera"):
        figure.add_argument(f"--{name}", help=f"the {name} that is shown")
    figure.add_argument("--frame", type=int, metavar="N", help="the frame that is shown")

    export = _add(verbs, "export", "rsavatar.cli_pictures:export", "take an avatar out: Gaussians, view, video", EXPORT)
    export.add_argument("source", metavar="ID|RUN", help="the id of a job, or a folder that `rsavatar run` wrote")
    export.add_argument("--out", type=Path, required=True, metavar="FILE", help=".ply, .png, .webp, .mp4, .webm, .gif")
    export.add_argument("--subject-dir", type=Path, metavar="DIR", help="of a RUN: the subject's folder")
    export.add_argument("--camera", help="a camera of the subject (default: one in front of the body)")
    export.add_argument("--shutter", help="global, blur, rolling, or bands:T")
    for name, about in (("time", "output frames"), ("readout", "source frames")):
        export.add_argument(f"--{name}", type=float, metavar="T", help=about)
    for name in ("azimuth", "elevation"):
        export.add_argument(f"--{name}", type=float, metavar="DEGREES")
    export.add_argument("--size", type=int, metavar="N", help="pixels of the longer side")
    return [figure, export]


def _add_grid(verbs: argparse._SubParsersAction[argparse.ArgumentParser]) -> argparse.ArgumentParser:
    grid = _add(verbs, "grid", "rsavatar.cli_grid:grid", "queue, follow or list grids of jobs", GRID)
    grid.add_argument("name", metavar="GRID", nargs="?", help="a built-in grid, a TOML file, or the id of a grid")
    grid.add_argument("--set", action="append", default=[], metavar="KEY=VALUE", help="a word of all jobs, or an axis")
    grid.add_argument("--subjects", metavar="A,B", help="on these subjects")
    grid.add_argument("--dry-run", action="store_true", help="how many jobs, how long; queue nothing")
    grid.add_argument("--key", help="idempotency key (default: a fresh one)")
    grid.add_argument("--force", action="store_true", help="run jobs even if their results are known")
    grid.add_argument("--watch", action="store_true", help="stay and follow it")
    verb = grid.add_mutually_exclusive_group()
    for name, about in (("cancel", "stop"), ("pause", "hold"), ("resume", "go on with"), ("retry", "queue again")):
        verb.add_argument(f"--{name}", action="store_true", help=f"{about} the jobs of the grid with this id")
    return grid


def _add_access(verbs: argparse._SubParsersAction[argparse.ArgumentParser]) -> list[argparse.ArgumentParser]:
    login = _add(verbs, "login", "rsavatar.cli_access:login", "keep a token for the service", LOGIN)
    login.add_argument("--forget", action="store_true", help="remove the kept token")
    nouns = verbs.add_parser("token", help="issue, list or revoke tokens").add_subparsers(required=True, metavar="VERB")
    create = _add(nouns, "create", "rsavatar.cli_access:create", "print a new token", TOKEN)
    create.add_argument("name", metavar="NAME", help="what it is for")
    create.add_argument("--owner", required=True, help="whose jobs it makes")
    create.add_argument("--scope", choices=["read", "submit", "admin"], default="submit", help="default: submit")
    create.add_argument("--days", type=float, default=90.0, metavar="N", help="its life; 0 = for ever (default: 90)")
    listing = _add(nouns, "list", "rsavatar.cli_access:show", "list tokens, newest first")
    revoke = _add(nouns, "revoke", "rsavatar.cli_access:revoke", "end a token, and the logins that it made, at once")
    revoke.add_argument("token_id", metavar="ID")
    nouns = verbs.add_parser("owner", help="limits of who submits jobs").add_subparsers(required=True, metavar="VERB")
    owners = _add(nouns, "list", "rsavatar.cli_access:show_owners", "list owners and their limits")
    allow = _add(nouns, "set", "rsavatar.cli_access:put_owner", "set an owner's limits", OWNER)
    allow.add_argument("name", metavar="NAME", help="as tokens name it")
    for name, about in (("queued", "wait"), ("running", "run at a time")):
        allow.add_argument(f"--{name}", type=int, metavar="N", help=f"jobs that may {about} (0: any number)")
    allow.add_argument("--share", type=float, default=1.0, metavar="X", help="of the workers (default: 1)")
    return [login, create, listing, revoke, owners, allow]


def _add(
    verbs: argparse._SubParsersAction[argparse.ArgumentParser], name: str, verb: str, about: str, epilog: str = ""
) -> argparse.ArgumentParser:
    parser: argparse.ArgumentParser = verbs.add_parser(
        name, help=about, description=f"{about[0].upper()}{about[1:]}.", epilog=epilog, formatter_class=_Layout
    )
    parser.add_argument("--debug", action="store_true", default=argparse.SUPPRESS, help="show tracebacks")
    parser.set_defaults(verb=verb)
    return parser


def _add_request(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("spec", metavar="SPEC", help="a TOML file, or a preset: smoke, draft, paper")
    parser.add_argument(
        "--set", action="append", default=[], metavar="KEY=VALUE", help="one word of the job; repeatable"
    )


def _add_id(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("job_id", metavar="ID")


class _Layout(argparse.RawDescriptionHelpFormatter):
    """Epilogs as they are written, columns wide enough for the verbs."""

    def __init__(self, prog: str) -> None:
        super().__init__(prog, max_help_position=28, width=100)


if __name__ == "__main__":
    sys.exit(main())
