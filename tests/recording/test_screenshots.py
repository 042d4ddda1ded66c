"""Every layout is drawn by the real viewer without a warning. Needs Vulkan; Mesa's software driver will do."""

from __future__ import annotations

import ctypes.util
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from apex_bat.recording.blueprints import pair_blueprint, save_blueprints
from apex_bat.recording.screenshots import SIZE, take_screenshot
from apex_bat.recording.viewing import PAIR_APPLICATION_ID, save_layout, write_pair
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


def test_pair_is_drawn_without_a_warning(recording: Path, room: Arena, tmp_path: Path) -> None:
    write_pair(recording, recording, tmp_path / "pair.rrd")
    layout = save_layout(pair_blueprint(room, ("one", "other")), PAIR_APPLICATION_ID, tmp_path)
    assert take_screenshot([tmp_path / "pair.rrd", layout], tmp_path / "a.png", 50) == []
