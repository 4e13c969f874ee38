"""``python -m services.paper --zju ROOT``: the paper's whole table, from ZJU-MoCap on disk to the last number.

Builds the six rolling-shutter subjects (what is built is kept), starts the service, runs every method on every subject
as one grid, prints the main table, and stops. Run again, it goes on: results that are known are not computed twice.
"""

from __future__ import annotations

import argparse
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

from services.demo import free_port, proof
from services.errors import ServiceError
from services.settings import Settings
from services.up import Stack, raise_interrupt, running

METHODS = ("gauhuman", "cvr+gauhuman", "jamnet+gauhuman", "mad-avatar", "rs-avatar")
LOOK_SECONDS = 0.3


def parser() -> argparse.ArgumentParser:
    """The command line."""
    words = argparse.ArgumentParser(
        "services.paper", description=__doc__, formatter_class=argparse.RawTextHelpFormatter
    )
    words.add_argument("--zju", type=Path, required=True, metavar="ROOT", help="folder with my_377 .. my_394")
    words.add_argument(
        "--out", type=Path, default=Path("data/rs-zju"), help="the built subjects (default: data/rs-zju)"
    )
    words.add_argument("--only", default="", metavar="A,B", help="of the six subjects only these")
    words.add_argument(
        "--methods", nargs="+", default=list(METHODS), metavar="METHOD", help="default: the paper's rows"
    )
    words.add_argument("--set", action="append", default=[], metavar="KEY=VALUE", help="a word of all jobs")
    words.add_argument("--build", nargs=argparse.REMAINDER, default=[], help="the rest: options of data build-zju")
    words.add_argument("--home", type=Path, default=Path("runs/paper"), help="the service's (default: runs/paper)")
    words.add_argument("--port", type=int, help="port of the API (default: any free one)")
    return words


def command(*words: str) -> list[str]:
    """A command of ``rsavatar``."""
    return [sys.executable, "-m", "rsavatar.cli", *words]


def build(options: argparse.Namespace) -> list[Path]:
    """The folders of the built subjects.

    Raises:
        subprocess.CalledProcessError: if one cannot be built; why, it has said itself.
    """
    only = ["--only", options.only] if options.only else []
    words = command("data", "build-zju", str(options.zju), "--out", str(options.out), *only, *options.build)
    done = subprocess.run(words, stdout=subprocess.PIPE, text=True, check=True)
    return [Path(line).resolve() for line in done.stdout.splitlines()]


def follow(stack: Stack, words: list[str], environment: dict[str, str]) -> int:
    """Run a command of the client while the service is kept alive; its exit status."""
    with subprocess.Popen(words, env=environment) as client:
        while client.poll() is None:
            stack.tend()
            time.sleep(LOOK_SECONDS)
        return client.returncode


def run(options: argparse.Namespace, settings: Settings) -> int:
    """Build, run the grid, print the table; the exit status."""
    folders = build(options)
    with running(settings) as stack:
        token = proof(settings).get("authorization", "").removeprefix("Bearer ")
        environment = os.environ | {"RSAVATAR_URL": settings.url} | ({"RSAVATAR_TOKEN": token} if token else {})
        for folder in folders:
            if status := follow(stack, command("subjects", "--add", folder.name, str(folder)), environment):
                return status
        methods = "[" + ", ".join(f'"{name}"' for name in options.methods) + "]"
        words = [word for setting in (f"method={methods}", *options.set) for word in ("--set", setting)]
        names = ",".join(folder.name for folder in folders)
        status = follow(stack, command("grid", "main", "--subjects", names, *words, "--watch"), environment)
        return follow(stack, command("table", "main", "--format", "md"), environment) or status


def main() -> int:
    """The whole table; 0 only if every job succeeded."""
    signal.signal(signal.SIGTERM, raise_interrupt)
    options = parser().parse_args()
    try:
        os.environ["RSAVATAR_HOME"] = str(options.home.resolve())
        return run(options, Settings(home=options.home.resolve(), port=options.port or free_port()))
    except ServiceError as error:
        print(error, file=sys.stderr)
    except subprocess.CalledProcessError:
        return 2
    except KeyboardInterrupt:
        print("stopped", flush=True)
    return 1


if __name__ == "__main__":
    sys.exit(main())
