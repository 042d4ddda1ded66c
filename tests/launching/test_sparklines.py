"""Curves of letters."""

import math

from apex_bat.launching.sparklines import MOST_VALUES, History, sparkline


def test_curve_runs_from_the_least_to_the_greatest_value() -> None:
    assert sparkline([0.0, 3.5, 7.0], 10) == "▁▅█"


def test_gaps_stay_gaps_and_a_flat_curve_is_flat() -> None:
    assert sparkline([1.0, math.nan, 1.0], 10) == "▁ ▁"
    assert sparkline([math.nan], 10) == ""
    assert sparkline([], 10) == ""


def test_long_curve_is_squeezed_into_the_width() -> None:
    assert sparkline([float(i) for i in range(80)], 8) == "▁▂▃▄▅▆▇█"


def test_history_of_a_long_run_stays_small_and_keeps_its_means() -> None:
    history = History()
    for second in range(2000):
        history.take(float(second), float(second))
    assert MOST_VALUES / 2 <= len(history.values) <= MOST_VALUES
    assert history.values == sorted(history.values)
    assert history.values[0] < 10.0
    assert history.values[-1] > 1980.0


def test_values_too_close_in_time_are_left_out() -> None:
    history = History()
    for tenth in range(20):
        history.take(1.0, tenth / 10)
    assert len(history.values) == 2
