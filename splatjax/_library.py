"""The folder of data that come with the package: materials, tables, the bust."""

from pathlib import Path


def profiles_folder() -> Path:
    """Return the folder of packaged data, which is inside the wheel or at the top of a checkout."""
    package = Path(__file__).resolve().parent
    in_wheel = package / "_profiles"
    return in_wheel if in_wheel.is_dir() else package.parent / "profiles"
