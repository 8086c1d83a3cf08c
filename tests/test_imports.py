"""`import splatjax` is quick: what takes long to import is imported where it is used."""

import json
import subprocess
import sys

LATER = [
    "IPython",
    "OpenImageIO",
    "colour",
    "matplotlib",
    "optax",
    "rich",
    "scipy.sparse",
    "scipy.spatial",
    "scipy.special",
    "trimesh",
    "tyro",
]


def test_what_takes_long_is_imported_where_it_is_used():
    program = "import json, sys, splatjax; print(json.dumps(sorted(sys.modules)))"
    said = subprocess.run(
        [sys.executable, "-c", program], capture_output=True, text=True, check=True
    ).stdout
    assert [name for name in LATER if name in json.loads(said)] == []
