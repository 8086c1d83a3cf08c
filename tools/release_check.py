"""Try what would be released: `make release-check` builds it into dist/ and runs this.

The sdist must make the same wheel, byte for byte. The wheel is installed in a bare environment, in
an empty folder with no checkout near, with the newest versions of what it needs, or by `--lowest`
with the lowest that pyproject.toml permits. There the program of the README and the command line
must run.
"""

import os
import re
import subprocess
import sys
import tarfile
import tempfile
import zipfile
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
_BIN = Path(sys.executable).parent


def run(*words: str | Path, cwd: Path) -> str:
    """Run a program as on a machine without this project; return what it prints."""
    ours = ("PYTHON", "VIRTUAL_ENV", "SPLATJAX")
    environment = {name: os.environ[name] for name in os.environ if not name.startswith(ours)}
    print("$", *(Path(word).name if isinstance(word, Path) else word for word in words), flush=True)
    command = [str(word) for word in words]
    finished = subprocess.run(
        command, cwd=cwd, env=environment, capture_output=True, text=True, check=False
    )
    check(not finished.returncode, f"{finished.stdout}{finished.stderr}\nfailed")
    return finished.stdout


def check(is_right: bool, fault: str) -> None:
    """Stop at a fault."""
    if not is_right:
        sys.exit(fault)


def check_contents(wheel: Path, sdist: Path, folder: Path) -> None:
    """Check that materials and types are in the wheel, and that the sdist makes the same wheel."""
    names = set(zipfile.ZipFile(wheel).namelist())
    needed = {f"splatjax/_profiles/{path.name}" for path in (ROOT / "profiles").iterdir()}
    missing = (needed | {"splatjax/py.typed"}) - names
    check(not missing, f"{wheel.name} lacks {', '.join(sorted(missing))}")
    strange = {name for name in names if not name.startswith(("splatjax/", "splatjax-"))}
    check(not strange, f"{wheel.name} holds {', '.join(sorted(strange))}")
    with tarfile.open(sdist) as archive:
        archive.extractall(folder, filter="data")
    source = folder / sdist.name.removesuffix(".tar.gz")
    run(_BIN / "hatchling", "build", "--target", "wheel", "--directory", folder, cwd=source)
    is_same = (folder / wheel.name).read_bytes() == wheel.read_bytes()
    check(is_same, f"{sdist.name} makes another wheel than the checkout")


def main() -> None:
    (wheel,), (sdist,) = (list((ROOT / "dist").glob(f"*{end}")) for end in (".whl", ".tar.gz"))
    with tempfile.TemporaryDirectory() as name:
        environment, empty = Path(name) / "bare", Path(name) / "empty"
        empty.mkdir()
        check_contents(wheel, sdist, Path(name))
        run(_BIN / "uv", "venv", "--quiet", "--python", sys.executable, environment, cwd=empty)
        python, splatjax = environment / "bin" / "python", environment / "bin" / "splatjax"
        least = ["--resolution", "lowest-direct", "--requirements", ROOT / "pyproject.toml"]
        choice = least if "--lowest" in sys.argv else []
        run(_BIN / "uv", "pip", "install", "--quiet", "--python", python, wheel, *choice, cwd=empty)
        program = "import splatjax; print(splatjax.__file__, splatjax.__version__)"
        file, version = run(python, "-c", program, cwd=empty).split()
        installed = Path(file).is_relative_to(environment) and version == wheel.name.split("-")[1]
        check(installed, f"not what was installed: {file} {version}")
        run(splatjax, "--help", cwd=empty)
        run(splatjax, "fit", "skin_light", "--output", "skin.toml", cwd=empty)
        readme = (ROOT / "README.md").read_text(encoding="utf-8")
        run(python, "-c", re.findall(r"```python\n(.*?)```", readme, re.DOTALL)[0], cwd=empty)
        made = sorted(path.name for path in empty.iterdir())
        check(made == ["bust.exr", "bust.png", "skin.toml"], f"made {', '.join(made)}")
    print(f"{wheel.name} and {sdist.name} work")


if __name__ == "__main__":
    main()
