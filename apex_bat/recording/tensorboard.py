"""What is used of tensorboardX: events, and who writes them.

Importing it imports torch, where that is installed, for functions that are not used here: 3 s and 250 MB of a launcher
that needs no torch (measured). So torch is hidden from it meanwhile, which it takes for a machine without torch.
"""

from __future__ import annotations

import sys
from collections.abc import Iterator
from contextlib import contextmanager


@contextmanager
def _torch_hidden() -> Iterator[None]:
    if "torch" in sys.modules:
        yield
        return
    sys.modules["torch"] = None  # type: ignore[assignment]  # importing what stands as None is an ImportError
    try:
        yield
    finally:
        del sys.modules["torch"]


with _torch_hidden():
    from tensorboardX.event_file_writer import EventsWriter
    from tensorboardX.proto.event_pb2 import Event
    from tensorboardX.proto.summary_pb2 import Summary
    from tensorboardX.record_writer import masked_crc32c

__all__ = ["Event", "EventsWriter", "Summary", "masked_crc32c"]
