"""Whether recordings can be decoded at all, tried in a process of its own.

Some damage, such as one flipped bit in the size of a buffer, makes rerun's decoder end the process that it runs in,
which nothing in Python can catch. A process costs 0.1 s, and each recording in it 0.02 s a MB (measured).

Run as a program, it reads names of files from its standard input and says after each that it has survived it.
"""

from __future__ import annotations

import subprocess
import sys
from collections.abc import Sequence
from pathlib import Path

TIMEOUT_S = 60.0
"""How long the first recording may take, and a sixtieth of it more for each further one."""
_END = "\0"


def undecodable(paths: Sequence[Path]) -> list[Path]:
    """Returns those recordings whose damage would end this process, or keep it for ever, if it read them.

    What is not there, or no recording, is not among them: to read that raises an error.
    """
    found, rest = [], list(paths)
    while rest:
        num_survived = _num_survived(rest)
        found += rest[num_survived : num_survived + 1]
        rest = rest[num_survived + 1 :]
    return found


def main() -> None:
    """Reads the files that standard input names."""
    from rerun_bindings.rerun_bindings import RrdReaderInternal  # the public class takes 0.6 s longer to import

    for name in sys.stdin.read().split(_END):
        try:
            reader = RrdReaderInternal(name)
            for chunk in reader.stream().to_chunks():
                chunk.to_record_batch()  # a zero in the name of a column ends the process only here
            reader.store()
        except Exception as error:
            print("refused", type(error).__name__, flush=True)  # noqa: T201  # a line for who started us
        else:
            print("read", flush=True)  # noqa: T201


def _num_survived(paths: Sequence[Path]) -> int:
    """Returns how many of some recordings, from the first on, a process reads before it ends.

    Raises:
        RuntimeError: it ended for another reason than what it read.
    """
    command = [sys.executable, "-m", __name__]
    text, timeout_s = _END.join(map(str, paths)), TIMEOUT_S * (1.0 + len(paths) / 60.0)
    try:
        done = subprocess.run(  # noqa: S603  # our own command
            command, input=text, capture_output=True, text=True, errors="replace", timeout=timeout_s, check=False
        )
    except subprocess.TimeoutExpired as error:
        said = error.stdout or b""
        return len((said if isinstance(said, bytes) else said.encode()).splitlines())
    num_said = len(done.stdout.splitlines())
    if done.returncode == 1:  # an exception, which a decoder that breaks off does not raise
        raise RuntimeError(f"recordings cannot be tried: {done.stderr[-1000:]}")
    return num_said


if __name__ == "__main__":
    main()
