"""The rows of a flight as a table for other programs: CSV or Parquet, one row a step."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pyarrow as pa  # type: ignore[import-untyped]
from numpy.typing import NDArray
from pyarrow import csv, parquet

from apex_bat.experience import NUM_BINS
from apex_bat.recording.flight import ACTION_NAMES, Flight
from apex_bat.recording.series import EAR_NAMES

ACTION_COLUMNS = ("q", "advantage")
STEP_COLUMNS = (
    "value",
    "reward_straight",
    "reward_near",
    "reward",
    "clearance_m",
    "progress_m",
    "distance_m",
    "contact",
)


def table_of(flight: Flight) -> pa.Table:
    """Returns the flight as a table: row k is the k-th call, what the bat chose, and what that led to.

    Columns: step, sim_time_s, the pose at the call (x_m, y_m, heading_rad) and at the next (next_...), action, q_...
    and advantage_... of each action, value, the terms of the reward, reward, return, clearance_m, progress_m,
    distance_m, contact, and the echo frames left_00 ... right_23.
    """
    columns: dict[str, NDArray[np.generic] | list[str]] = {
        "step": np.arange(flight.num_steps),
        "sim_time_s": flight.times_s[:-1],
    }
    for number, name in enumerate(("x_m", "y_m", "heading_rad")):
        columns[name], columns[f"next_{name}"] = flight.poses[:-1, number], flight.poses[1:, number]
    columns["action"] = [ACTION_NAMES[action] for action in flight.action]
    for name in ACTION_COLUMNS:
        for number, action in enumerate(ACTION_NAMES):
            columns[f"{name}_{action}"] = getattr(flight, name)[:, number]
    columns |= {name: getattr(flight, name) for name in STEP_COLUMNS}
    columns["return"] = flight.returns
    for number, ear in enumerate(EAR_NAMES):
        columns |= {f"{ear}_{value:02d}": flight.frame[:, number, value] for value in range(NUM_BINS)}
    return pa.table(
        {name: values if isinstance(values, list) else np.ascontiguousarray(values) for name, values in columns.items()}
    )


def write_csv(flight: Flight, path: Path) -> None:
    """Writes the table of a flight as CSV."""
    csv.write_csv(table_of(flight), path)


def write_parquet(flight: Flight, path: Path) -> None:
    """Writes the table of a flight as Parquet."""
    parquet.write_table(table_of(flight), path)
