"""A TensorBoard event file that goes on where it ended and takes its time from a clock: equal runs, equal bytes."""

from __future__ import annotations

import struct
from collections.abc import Callable

from apex_bat.recording.tensorboard import Event, masked_crc32c

FILE_VERSION = "brain.Event:2"


class EventFile:
    """Appends events to PREFIX.out.tfevents.serialSUFFIX.

    tensorboardX's writer begins a new file at each start, whose name and first event tell the time of day and the host.
    """

    def __init__(self, prefix: str, suffix: str, clock: Callable[[], float]) -> None:
        """Opens or begins the file. Raises OSError."""
        self._file = open(f"{prefix}.out.tfevents.serial{suffix}", "ab")  # noqa: SIM115  # closed by `close`
        if self._file.tell() == 0:
            self.write_event(Event(wall_time=clock(), file_version=FILE_VERSION))

    def write_event(self, event: Event) -> None:
        """Appends an event as a record: length, its checksum, data, their checksum."""
        data = event.SerializeToString(deterministic=True)
        length = struct.pack("<Q", len(data))
        crc = struct.pack("<I", masked_crc32c(length)), struct.pack("<I", masked_crc32c(data))
        self._file.write(length + crc[0] + data + crc[1])

    def flush(self) -> None:
        """Hands what was written to the system."""
        self._file.flush()

    def close(self) -> None:
        """Closes the file."""
        self._file.close()
