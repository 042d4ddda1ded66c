"""Tables of a flight hold its numbers."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from pyarrow import csv, parquet  # type: ignore[import-untyped]

from apex_bat.recording.flight import ACTION_NAMES, Flight
from apex_bat.recording.tables import table_of, write_csv, write_parquet


def test_columns_are_the_arrays_of_the_flight(flight: Flight) -> None:
    table = table_of(flight)
    assert table.num_rows == flight.num_steps
    for name, expected in {
        "sim_time_s": flight.times_s[:-1],
        "heading_rad": flight.poses[:-1, 2],
        "next_x_m": flight.poses[1:, 0],
        "q_left": flight.q[:, 1],
        "advantage_right": flight.advantage[:, 2],
        "value": flight.value,
        "return": flight.returns,
        "contact": flight.contact,
        "left_03": flight.frame[:, 0, 3],
        "right_23": flight.frame[:, 1, 23],
    }.items():
        np.testing.assert_array_equal(table[name].to_numpy(), expected, err_msg=name)
    assert table["action"].to_pylist() == [ACTION_NAMES[action] for action in flight.action]


def test_files_hold_the_table(flight: Flight, tmp_path: Path) -> None:
    write_parquet(flight, tmp_path / "a.parquet")
    assert parquet.read_table(tmp_path / "a.parquet") == table_of(flight)
    write_csv(flight, tmp_path / "a.csv")
    read = csv.read_csv(tmp_path / "a.csv")
    assert read.column_names == table_of(flight).column_names
    np.testing.assert_allclose(read["clearance_m"].to_numpy(), flight.clearance_m, rtol=1e-6)
