"""Every layout is drawn by the real viewer without a warning. Needs Vulkan; Mesa's software driver will do."""

from __future__ import annotations

import ctypes.util
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from apex_bat.config import Config
from apex_bat.recording.blueprints import pair_blueprint, save_blueprints
from apex_bat.recording.screenshots import SIZE, ScreenshotError, take_screenshot
from apex_bat.recording.training import TRAINING_RECORDING, TrainingRecording
from apex_bat.recording.viewing import PAIR_APPLICATION_ID, save_layout, write_pair
from apex_bat.roles.metrics import DECLARED
from apex_bat.simulation.layout import Arena

pytestmark = [
    pytest.mark.slow,
    pytest.mark.timeout(300),
    pytest.mark.skipif(ctypes.util.find_library("vulkan") is None, reason="the viewer draws with Vulkan"),
]


@pytest.mark.parametrize("layout", ["flight", "ear", "policy"])
def test_layout_is_drawn_without_a_warning(layout: str, recording: Path, room: Arena, tmp_path: Path) -> None:
    save_blueprints(tmp_path, room)
    assert take_screenshot([recording, tmp_path / f"{layout}.rbl"], tmp_path / "a.png", 50) == []
    picture = np.asarray(Image.open(tmp_path / "a.png"))
    assert picture.shape[1::-1] == SIZE
    assert picture.std() > 10.0


@pytest.mark.parametrize("view", ["flight", "ear", "policy"])
def test_pair_is_drawn_without_a_warning(view: str, recording: Path, room: Arena, tmp_path: Path) -> None:
    write_pair(recording, recording, tmp_path / "pair.rrd")
    layout = save_layout(pair_blueprint(room, ("one", "other"), view), PAIR_APPLICATION_ID, tmp_path)
    assert take_screenshot([tmp_path / "pair.rrd", layout], tmp_path / "a.png", 50) == []


def test_a_step_beyond_the_flight_is_refused(recording: Path, tmp_path: Path) -> None:
    with pytest.raises(ScreenshotError, match="no step 100000; the last is"):
        take_screenshot([recording], tmp_path / "a.png", 100_000)


def test_training_is_drawn_without_a_warning(tmp_path: Path) -> None:
    (tmp_path / "recordings").mkdir()
    training = TrainingRecording(Config(), tmp_path)
    common = {"pid": 1, "state": "judged it", "learner_step": 5}
    for second in range(30):
        moment = {"unix_s": second, "elapsed_s": second, "env_steps_total": second, "learner_step_total": second}
        for role, metrics in DECLARED.items():
            name = "actor-0" if role == "actor" else role
            training.take(common | moment | {"role": name} | dict.fromkeys(metrics, 0.1 * second))
    training.close()
    path = tmp_path / "recordings" / TRAINING_RECORDING
    assert take_screenshot([path], tmp_path / "a.png", 25) == []
