"""The oldest Python that is promised reads all of both packages."""

import shutil
import subprocess
from pathlib import Path

import pytest

SCRIPT = Path(__file__).parents[3] / ".ci" / "import_on_oldest.py"


def _oldest():
    """Return the oldest Python as it is installed, or as pyenv keeps it; None without one."""
    found = [shutil.which("python3.10"), *Path.home().glob(".pyenv/versions/3.10.*/bin/python")]
    runs = (
        p for p in found if p and not subprocess.run([p, "-c", ""], capture_output=True).returncode
    )
    return next(runs, None)


OLDEST = _oldest()


@pytest.mark.skipif(OLDEST is None, reason="there is no Python 3.10")
def test_both_packages_are_imported_on_the_oldest_python():
    done = subprocess.run([OLDEST, SCRIPT], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
