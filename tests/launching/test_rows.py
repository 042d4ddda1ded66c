"""Rows of the metrics: every report at first, few later, and no mean loses what lies between."""

import pytest

from apex_bat.launching.rows import RowThinner, joined
from apex_bat.transport.messages import Report


def report(process: int = 1, **metrics: float) -> Report:
    figures = {name.replace("share_", "share."): value for name, value in metrics.items()}
    return Report("learner", process, "here", "", "learning", figures)


def test_every_report_is_a_row_in_the_dense_time() -> None:
    thinner = RowThinner(dense_rows_s=100.0)
    assert all(thinner.take(report(loss=float(second)), float(second)) for second in range(100))


def test_later_rows_grow_with_the_logarithm_of_time() -> None:
    thinner = RowThinner(dense_rows_s=100.0)
    rows = [thinner.take(report(updates=float(second)), float(second)) for second in range(10_000)]
    assert 400 <= sum(row is not None for row in rows) <= 600, "100 (1 + ln 100) = 560"
    late = [second for second, row in enumerate(rows) if row is not None and second > 9_000]
    assert late[1] - late[0] == pytest.approx(91, abs=3)


def test_joined_means_are_weighted_counts_added_rates_averaged_and_counters_newest() -> None:
    row = joined(
        [
            report(loss=1.0, loss_count=1.0, updates=1.0, updates_per_s=1.0, share_update=0.5),
            report(updates=2.0, updates_per_s=1.0),
            report(loss=4.0, loss_count=2.0, updates=6.0, updates_per_s=4.0, share_update=1.0),
        ]
    )
    assert row.metrics == {
        "loss": 3.0, "loss_count": 3.0, "updates": 6.0, "updates_per_s": 2.0, "share.update": 0.5,
    }  # fmt: skip


def test_counts_of_all_rows_together_are_those_of_all_reports() -> None:
    thinner = RowThinner(dense_rows_s=10.0)
    rows = [thinner.take(report(1 + second // 333, loss=2.0, loss_count=1.0), float(second)) for second in range(1000)]
    rows += thinner.rest()
    assert sum(row.metrics["loss_count"] for row in rows if row is not None) == 1000
    assert not thinner.rest()


def test_what_a_process_left_is_a_row_of_its_own() -> None:
    thinner = RowThinner(dense_rows_s=1.0)
    thinner.take(report(1, loss=1.0, loss_count=1.0), 100.0)
    assert thinner.take(report(1, loss=3.0, loss_count=1.0), 101.0) is None
    row = thinner.take(report(2, loss=5.0, loss_count=1.0), 102.0)
    assert row is not None
    assert (row.pid, row.metrics["loss"]) == (1, 3.0)
