"""The two ends that talk to a replay server: the actor's writer and the learner's reader."""

from __future__ import annotations

from apex_bat.replay.reader import ReplayReader
from apex_bat.replay.turns import TurnWriter
from apex_bat.replay.writer import ReplayWriter

__all__ = ["ReplayReader", "ReplayWriter", "TurnWriter"]
