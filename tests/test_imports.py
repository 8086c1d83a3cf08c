"""`import splatjax` is quick: what takes long to import is imported where it is used."""

import json
import subprocess
import sys
from types import ModuleType

import splatjax

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


def test_public_names_are_few_and_submodules_documented():
    public = {name: value for name, value in vars(splatjax).items() if not name.startswith("_")}
    modules = {name for name, value in public.items() if isinstance(value, ModuleType)}
    assert len(public) - len(modules) <= 45
    assert all(f"{name}`" in splatjax.__doc__ for name in modules - {"cli"})
