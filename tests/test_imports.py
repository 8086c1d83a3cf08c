"""`import splatjax` is quick: what takes long to import is imported where it is used."""

import json
import pkgutil
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
    assert sum(not isinstance(value, ModuleType) for value in public.values()) <= 45
    packages = {each.name for each in pkgutil.iter_modules(splatjax.__path__)}
    described = {name for name in packages if f"{name}`" in splatjax.__doc__}
    assert {name for name in packages - described if name[0] != "_"} == {"cli", "render"}
