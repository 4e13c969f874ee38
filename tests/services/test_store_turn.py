from __future__ import annotations

import subprocess
import sys
import threading
import time
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import pytest

from services.settings import ROOT
from services.store.turn import Turn

HOLDER = """
import sys, time
from pathlib import Path
from services.store.turn import Turn
with Turn(Path(sys.argv[1])).take():
    print("mine", flush=True)
    time.sleep(60)
"""


def test_one_writer_at_a_time_over_all_stores_of_a_file(tmp_path: Path) -> None:
    turns = [Turn(tmp_path / "turn") for _ in range(4)]
    inside, most = 0, 0

    def write(turn: Turn) -> None:
        nonlocal inside, most
        for _ in range(20):
            with turn.take():
                inside += 1
                most = max(most, inside)
                time.sleep(0.0002)
                inside -= 1

    with ThreadPoolExecutor(8) as pool:
        list(pool.map(write, turns * 2))
    assert (inside, most) == (0, 1)
    for turn in turns:
        turn.close()


def test_a_process_that_is_killed_gives_its_turn_back(tmp_path: Path) -> None:
    path = tmp_path / "turn"
    command = [sys.executable, "-c", HOLDER, str(path)]
    with subprocess.Popen(command, cwd=ROOT, stdout=subprocess.PIPE, text=True) as holder:
        assert holder.stdout is not None
        assert holder.stdout.readline() == "mine\n"
        got = threading.Event()

        def wait() -> None:
            turn = Turn(path)
            with turn.take():
                got.set()
            turn.close()

        waiting = threading.Thread(target=wait)
        waiting.start()
        assert not got.wait(0.2)
        holder.kill()
        assert got.wait(10.0)
        waiting.join()


def test_a_stopped_process_is_not_waited_for_for_ever(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("services.store.turn.PATIENCE_SECONDS", 0.05)
    holder, other = Turn(tmp_path / "turn"), Turn(tmp_path / "turn")
    with holder.take(), other.take():  # SQLite's own lock decides between the two
        pass
    with other.take(), Turn(None).take():
        pass
    holder.close()
    other.close()


def test_other_databases_need_no_queue(tmp_path: Path) -> None:
    turn = Turn(None)
    with turn.take(), turn.take():
        pass
    turn.close()
    assert list(tmp_path.iterdir()) == []
