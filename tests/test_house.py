"""The walls of the house: which room may import which (pyproject.toml, import-linter)."""

import subprocess
import sys
from pathlib import Path

ROOT = Path(__file__).parents[1]


def test_data_flows_one_way():
    command = [str(Path(sys.executable).parent / "lint-imports"), "--no-cache"]
    report = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=False)
    assert report.returncode == 0, report.stdout + report.stderr
