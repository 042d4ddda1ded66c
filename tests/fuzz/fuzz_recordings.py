"""Fuzzes the reading of recordings: what is damaged is read, repaired or refused in one line.

By hand: `python -m tests.fuzz.fuzz_recordings FIRST NUMBER`, which takes the damage of the seeds from FIRST on and says
what became of each. The reader is native and not ours, so that damage may end the process that reads; so it is not
guided by coverage, and the quick suite starts it in a process of its own.
"""

from __future__ import annotations

import random
import sys
import tempfile
from pathlib import Path

import numpy as np

from apex_bat.config import settings
from apex_bat.recording.episodes import write_flight
from apex_bat.recording.hearing import Directions
from apex_bat.recording.reading import RecordingError, is_whole, read_flight, repair_recording
from apex_bat.simulation.layout import Arena, Wall
from tests.recording.conftest import make_flight

NUM_STEPS, NUM_POINTS = 6, 4


def small_recording(path: Path) -> bytes:
    """Returns the bytes of a recording of a few steps, which is written at a path."""
    arena = Arena(name="room", start=(0.0, 0.0), walls=(Wall(2.0, 0.0, 1.57, 4.0, 0.15, 1.0),), pillars=())
    directions = Directions(np.zeros(NUM_POINTS), np.linspace(-1.0, 1.0, NUM_POINTS))
    write_flight(make_flight(NUM_STEPS, NUM_POINTS), arena, settings.Sonar(), directions, path)
    return path.read_bytes()


def damaged(content: bytes, seed: int) -> bytes:
    """Returns bytes with a few of them changed, added or taken out, or with their end cut off."""
    generator, data = random.Random(seed), bytearray(content)  # noqa: S311  # no secret
    how = generator.choice(["flip", "flip", "zero", "insert", "delete", "cut"])
    for _ in range(generator.randint(1, 4)):
        near_an_end = generator.choice([generator.randrange(200), len(data) - 1 - generator.randrange(300)])
        place = near_an_end if generator.random() < 0.3 else generator.randrange(len(data))
        if how == "cut":
            return bytes(data[:place])
        if how == "flip":
            data[place] ^= generator.randrange(1, 256)
        elif how == "zero":
            end = min(len(data), place + generator.randrange(1, 64))
            data[place:end] = bytes(end - place)
        elif how == "insert":
            data[place:place] = generator.randbytes(generator.randrange(1, 20))
        else:
            del data[place : place + generator.randrange(1, 20)]
    return bytes(data)


def outcome_of(path: Path) -> str:
    """Returns what becomes of a file that `inspect` is to open: read, repaired or refused."""
    try:
        read_flight(path)
        if is_whole(path):
            return "read"
        repair_recording(path, path.with_suffix(".repaired.rrd"))
    except RecordingError as error:
        if "\n" in str(error).strip() or path.name not in str(error):
            raise AssertionError(f"not one clear line: {error}") from error
        return "refused"
    return "repaired"


def main(first: int, number: int) -> None:
    """Says what becomes of recordings with the damage of some seeds."""
    with tempfile.TemporaryDirectory(prefix="apex_bat-fuzz-") as folder:
        path = Path(folder, "flight.rrd")
        whole = small_recording(path)
        for seed in range(first, first + number):
            path.write_bytes(damaged(whole, seed))
            print(seed, outcome_of(path), flush=True)  # noqa: T201  # a line for who runs it


if __name__ == "__main__":
    main(int(sys.argv[1]), int(sys.argv[2]))
