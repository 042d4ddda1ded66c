"""One thread for linear algebra in all tests, as in the roles: idle threads that spin slow a busy machine down."""

import os

from apex_bat.launching import ONE_THREAD

for _name in ONE_THREAD:
    os.environ[_name] = "1"
