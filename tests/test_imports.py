"""`import splatjax` is quick: what takes long to import is imported where it is used. It
changes no setting of JAX. No package that splatjax installs, or is tested with, is under a
copyleft license.
"""

import json
import pkgutil
import re
import subprocess
import sys
from importlib.metadata import distributions
from pathlib import Path
from types import ModuleType

import pytest

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


def test_importing_is_quick_and_changes_no_setting_of_jax():
    program = """
import json, sys, equinox, jax
before = dict(jax.config.values)
import splatjax
print(json.dumps(sorted(sys.modules)))
import splatjax.cli
assert before == jax.config.values
"""
    output = subprocess.run(
        [sys.executable, "-c", program], capture_output=True, text=True, check=True
    ).stdout
    assert [name for name in LATER if name in json.loads(output)] == []


def test_modules_are_short():
    modules = Path(splatjax.__file__).parent.rglob("*.py")
    assert [path.name for path in modules if path.read_text().count("\n") > 330] == []


def test_public_names_are_few_and_submodules_documented():
    public = {name: value for name, value in vars(splatjax).items() if not name.startswith("_")}
    assert sum(not isinstance(value, ModuleType) for value in public.values()) <= 45
    packages = {each.name for each in pkgutil.iter_modules(splatjax.__path__)}
    described = {name for name in packages if f"{name}`" in splatjax.__doc__}
    assert {name for name in packages - described if name[0] != "_"} == {"cli", "render"}


COPYLEFT = re.compile(r"\b(A|L)?GPL|General Public License", re.IGNORECASE)
# Packages whose license mentions such a license without being one.
MENTIONED = {
    "scipy": "BSD; its wheels hold libgfortran, under the GPL with an exception for libraries",
    "matplotlib": "PSF; its text compares itself with the GPL",
}


@pytest.mark.once
def test_no_installed_package_is_copyleft():
    found = {}
    for package in distributions():
        meta = package.metadata
        classifiers = [line for line in meta.get_all("Classifier", []) if "License" in line]
        texts = [meta.get("License-Expression"), meta.get("License"), *classifiers]
        if any(COPYLEFT.search(text) for text in texts if text):
            found[meta["Name"].lower()] = texts
    assert found.keys() <= MENTIONED.keys()
