"""No package that splatjax installs, or is tested with, is under a copyleft license."""

import re
from importlib.metadata import distributions

import pytest

COPYLEFT = re.compile(r"\b(A|L)?GPL|General Public License", re.IGNORECASE)
MENTIONED = {
    "scipy": "BSD; its wheels hold libgfortran, under the GPL with an exception for libraries",
    "matplotlib": "PSF; its text compares itself with the GPL",
}
"""Packages whose license mentions such a license without being one."""


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
