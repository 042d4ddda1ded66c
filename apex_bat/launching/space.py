"""Whether a run fits on its disk: what its settings let it take, beside what is free."""

from __future__ import annotations

import logging
import math
import shutil
from pathlib import Path

from apex_bat.agent.inference import parameter_shapes
from apex_bat.config import Config
from apex_bat.experience import ACTION_MEMORY
from apex_bat.replay.buffer import FRAME_VALUES, ITEM
from apex_bat.replay.store import ROW_RESERVE
from apex_bat.roles.plan import roles_of

NUM_SNAPSHOTS = 3  # the newest, the one before, and the one being written
NUM_NETWORKS = 5  # in a checkpoint, of float32: online, target, average, and two moments of the optimiser
_ROW_BYTES = 4 * FRAME_VALUES + 2  # float32, action and step
_log = logging.getLogger(__name__)


def bounds_of(config: Config) -> dict[str, float]:
    """Returns the most bytes that each folder of a run may come to take, as its settings bound them.

    Metrics are not among them: they grow with the time that a run takes.
    """
    launch = config.launch
    shapes = parameter_shapes(config.network, config.state_steps).values()
    checkpoint = 4.0 * NUM_NETWORKS * sum(math.prod(shape) for shape in shapes)
    num_logs = (len(roles_of(config)) + 1) * (launch.log_files + 1)  # the launcher has one too
    return {
        "replay": NUM_SNAPSHOTS * snapshot_bytes(config),
        "checkpoints": (config.checkpoint.keep + 3) * checkpoint,  # the best, one of each being written
        "recordings": config.recording.max_mb * 1e6,
        "logs": num_logs * launch.log_max_mb * 1e6,
    }


def snapshot_bytes(config: Config) -> float:
    """Returns the bytes of a snapshot of the full replay, of all shards together, reckoned as `ReplayStore` is made.

    Reckoned, and not asked of one: the replay may be larger than the memory of the launcher's machine.
    """
    chunk, context = config.actor.chunk_transitions, max(config.state_steps - 1, ACTION_MEMORY)
    rows_each = ROW_RESERVE * (chunk + context + config.learner.num_step) / chunk
    num_rows = rows_each * (config.replay.capacity + config.replay.shards * config.largest_insert)
    return num_rows * _ROW_BYTES + config.replay.capacity * ITEM.itemsize


def warn_if_short(config: Config, run: Path) -> str:
    """Says in the log, in one line, if a run may come to need more space than its disk has; returns what was said.

    It is no reason not to start: a run may end long before, and goes on without what a full disk does not take.
    """
    needed = {name: max(0.0, most - _size_of(run / name)) for name, most in bounds_of(config).items()}
    try:
        free = shutil.disk_usage(run).free
    except OSError:  # then nobody knows
        return ""
    if sum(needed.values()) <= free:
        return ""
    parts = ", ".join(f"{name} {size / 1e9:.3g}" for name, size in needed.items())
    text = (
        f"{run}: its disk has {free / 1e9:.3g} GB free, and the run may come to take {sum(needed.values()) / 1e9:.3g} "
        f"GB ({parts}); what does not fit will be left out"
    )
    _log.warning("%s", text)
    return text


def _size_of(folder: Path) -> float:
    """Returns the bytes that the files of a folder have already; 0 if there is none."""
    return float(sum(path.stat().st_size for path in folder.rglob("*") if path.is_file()))
