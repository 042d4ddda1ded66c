"""What `apex-bat status` says of a run: the roles' rows, and whether a launcher stands behind them."""

from __future__ import annotations

import math
import socket
import time
from datetime import datetime
from pathlib import Path
from typing import Any

from apex_bat.roles.resources import is_same_process
from apex_bat.storage import StorageError, read_json

STATUS = "status.json"
QUIET_S = 10.0
"""A launcher writes its status every second; one that has not for so long is stopped, or its disk is full or slow."""
_RATES = (("env_steps_per_s", "steps/s"), ("updates_per_s", "updates/s"))


def read_status(run: Path, now_unix_s: float | None = None) -> dict[str, Any]:
    """Returns the content of a run's status.json, its ages brought up to now.

    Beside what the launcher wrote it holds `launcher`: "runs", "quiet", "gone" or "ended", and `verdict`: that in a
    line for a person. Of a launcher that is gone or ended, each role's pid is None and its state is "not running": what
    it did last is in `last_state`.

    Raises:
        StorageError: there is no status, or it is damaged.
    """
    path = run / STATUS
    try:
        content = read_json(path)
        written_unix_s, roles = float(content["written_unix_s"]), list(content["roles"])
        age_s = (time.time() if now_unix_s is None else now_unix_s) - written_unix_s
        for row in roles:
            if row["heartbeat_age_s"] is not None:
                row["heartbeat_age_s"] = round(row["heartbeat_age_s"] + age_s, 2)
            row["last_state"] = row["state"]
        content["launcher"], content["verdict"] = _judge(content, age_s, written_unix_s)
    except StorageError as error:
        raise error if path.exists() else StorageError(f"{run}: no status.json; no run was started here") from None
    except (OSError, ValueError, KeyError, TypeError, AttributeError, OverflowError) as error:
        raise StorageError(f"{path}: damaged: {error!r}") from None
    if content["launcher"] in ("gone", "ended"):
        for row in roles:
            row["pid"], row["state"] = None, "not running"
    return content


def is_launched(run: Path) -> bool:
    """Whether a launcher runs in a folder, as far as its status tells: not if it is silent on another machine."""
    try:
        content = read_status(run)
    except StorageError:
        return False
    is_here = content.get("host") == socket.gethostname()
    return content["launcher"] == "runs" or (content["launcher"] == "quiet" and is_here)


def figures(row: dict[str, Any]) -> dict[str, str]:
    """Returns what a role's newest report says, as texts: rate, lag, memory and open files; "-" for what it does not.

    The lag is the learner's steps that the weights in use are behind, or for the replay those of arriving inserts.
    """
    metrics = row.get("metrics", {})
    rate = next((f"{metrics[name]:,.0f} {unit}" for name, unit in _RATES if name in metrics), None)
    lag = metrics.get("policy_lag", metrics.get("replay.policy_lag", math.nan))
    memory_mb, num_open = metrics.get("process.memory_mb"), metrics.get("process.open_files")
    if rate is None and "replay.size" in metrics:
        rate = f"{metrics['replay.size']:,.0f} held"
    return {
        "rate": rate or "-",
        "lag": "-" if math.isnan(lag) else f"{lag:,.0f}",
        "memory": "-" if memory_mb is None else f"{memory_mb:,.0f} MB",
        "files": "-" if num_open is None else f"{num_open:.0f}",
    }


def _judge(content: dict[str, Any], age_s: float, written_unix_s: float) -> tuple[str, str]:
    pid, since = content["launcher_pid"], _clock(written_unix_s)
    if content.get("ended"):
        return "ended", f"the run ended at {since}; these are its last figures"
    birth = content.get("launcher_birth", content.get("launcher_began_unix_s"))  # as older versions noted it
    is_here = content.get("host") == socket.gethostname()
    if is_here and birth is not None and not is_same_process(pid, birth):
        return "gone", f"launcher gone since {since} (pid {pid}); these are the last figures it wrote"
    if age_s > QUIET_S:
        what = "it lives: stopped, or its disk is full or slow" if is_here else f"on {content.get('host')}"
        return "quiet", f"launcher silent since {since}, {age_s:.0f} s ago (pid {pid}, {what})"
    return "runs", content.get("stall") or ""


def _clock(unix_s: float) -> str:
    return datetime.fromtimestamp(unix_s).astimezone().isoformat(sep=" ", timespec="seconds")
