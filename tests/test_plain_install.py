"""The plain install is what a companion computer gets: it must be enough for `flight` and `safety`, and no more."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parent.parent
HEAVY = ("torch", "jsbsim", "pymavlink", "gymnasium", "numba", "matplotlib", "onnx")


@pytest.fixture(scope="module")
def plain_python(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A new environment with the plain install of this project, not editable, versions as pinned."""
    folder = tmp_path_factory.mktemp("plain") / "venv"
    subprocess.run([sys.executable, "-m", "venv", str(folder)], check=True, timeout=120)
    python = folder / "bin" / "python"
    install = [str(python), "-m", "pip", "install", "-q", "--disable-pip-version-check", "-c", "constraints.txt", "."]
    done = subprocess.run(install, cwd=ROOT, capture_output=True, text=True, timeout=280, check=False)
    assert done.returncode == 0, done.stderr[-2000:]
    return python


@pytest.mark.timeout(500)
def test_flight_and_safety_import_with_the_plain_install_only(plain_python: Path, tmp_path: Path) -> None:
    code = (
        "import flight, safety, importlib, pkgutil\n"
        "for house in (flight, safety):\n"
        "    for module in pkgutil.walk_packages(house.__path__, house.__name__ + '.'):\n"
        "        if not module.name.endswith('__main__'): importlib.import_module(module.name)\n"
        "import importlib.util as u\n"
        f"print([name for name in {HEAVY!r} if u.find_spec(name)])"
    )
    done = subprocess.run([str(plain_python), "-c", code], cwd=tmp_path, capture_output=True, text=True, timeout=60, check=False)
    assert done.returncode == 0, done.stderr
    assert done.stdout.strip() == "[]"
    help_text = subprocess.run(
        [str(plain_python.parent / "fly"), "--help"], cwd=tmp_path, capture_output=True, text=True, timeout=60, check=False
    )
    assert help_text.returncode == 0, help_text.stderr
    assert "--mission" in help_text.stdout
