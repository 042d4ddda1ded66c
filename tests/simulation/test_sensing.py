"""The three conditions of the thesis."""

import numpy as np

from apex_bat.config.settings import Sensing
from apex_bat.experience import stack_state
from apex_bat.simulation.sensing import keep_onsets, silent_history, stack_echoes


def test_onset_keeps_the_first_value_above_the_threshold_only() -> None:
    row = np.array([[0.001, 0.0131, 0.2, 0.5, 0.1]], np.float32)
    np.testing.assert_array_equal(keep_onsets(row, Sensing()), np.array([[0, 0, 0.2, 0, 0]], np.float32))


def test_onset_may_be_copied_to_the_rest() -> None:
    row = np.array([[0.001, 0.0, 0.2, 0.5, 0.1]], np.float32)
    copied = keep_onsets(row, Sensing(onset="copy"))
    np.testing.assert_array_equal(copied, np.array([[0, 0, 0.2, 0.2, 0.2]], np.float32))


def test_a_row_without_onset_is_blank() -> None:
    row = np.full((2, 3, 24), 0.013, np.float32)
    assert not keep_onsets(row, Sensing()).any()
    assert not keep_onsets(row, Sensing(onset="copy")).any()


def test_onset_threshold_is_a_setting() -> None:
    row = np.array([[0.1, 0.3]], np.float32)
    np.testing.assert_array_equal(keep_onsets(row, Sensing(onset_threshold=0.2)), np.array([[0, 0.3]], np.float32))


def test_echoes_are_stacked_as_the_learner_stacks_them() -> None:
    frames = np.random.default_rng(0).random((7, 2, 24)).astype(np.float32)
    for condition, heard in (("memory", 3), ("no_memory", 1)):
        learner = stack_state(frames, np.zeros(7, np.uint8), np.array([6]), 0, 3, heard)
        np.testing.assert_array_equal(stack_echoes(frames[None, 4:], condition), learner.echoes)


def test_stacking_leaves_the_history_as_it_was() -> None:
    history = np.ones((1, 3, 2, 24), np.float32)
    stack_echoes(history, "no_memory")[:] = 7.0
    assert (history == 1.0).all()


def test_memory_begins_in_silence() -> None:
    history = silent_history(5, Sensing(memory_steps=2))
    assert history.shape == (5, 2, 2, 24)
    assert not history.any()
