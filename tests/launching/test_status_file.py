"""What a launcher writes of a run is what `status` reads of it."""

from __future__ import annotations

import os
import time
from pathlib import Path

from apex_bat.config import Config
from apex_bat.launching.standing import Origin, Standing
from apex_bat.launching.status import is_launched, read_status
from apex_bat.launching.status_file import StatusFile
from apex_bat.launching.supervisor import Watched
from apex_bat.roles.plan import roles_of


def test_a_status_is_read_as_that_of_the_launcher_that_wrote_it(tmp_path: Path) -> None:
    config = Config()
    standing = Standing(config, time.monotonic(), Origin(640.0, 7.0, 40.0, 30.0))
    watched = {role.name: Watched(role) for role in roles_of(config)}
    file = StatusFile(tmp_path)
    file.write(standing, watched, has_ended=False, refused_reports={"forged": 3})
    status = read_status(tmp_path)
    assert status["launcher"] == "runs"
    assert status["launcher_pid"] == os.getpid()
    assert status["refused_reports"] == {"forged": 3}
    assert status["progress"]["env_steps"] == 640.0
    assert [row["role"] for row in status["roles"]] == list(watched)
    assert is_launched(tmp_path)
    file.write(standing, watched, has_ended=True)
    assert read_status(tmp_path)["launcher"] == "ended"
