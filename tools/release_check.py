"""Try what would be released: `make release-check` builds it into dist/ and runs this.

The wheel is installed in a bare environment, in an empty folder with no checkout near; there the
program of the README and the command line must run, and `import splatjax` may take a second more
than `import jax`.
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
DIST = ROOT / "dist"
LONGEST_IMPORT = 1.0  # seconds beyond that of jax
_BIN = Path(sys.executable).parent


def run(*words: str | Path, cwd: Path, **kwargs) -> str:
    """Run a program as one finds it on a machine without this project; give what it prints."""
    kept = {
        name: value
        for name, value in os.environ.items()
        if not name.startswith(("PYTHON", "VIRTUAL_ENV", "SPLATJAX"))
    }
    print("$", *(Path(word).name if isinstance(word, Path) else word for word in words), flush=True)
    finished = subprocess.run(
        [*map(str, words)], cwd=cwd, env=kept, capture_output=True, text=True, check=False, **kwargs
    )
    if finished.returncode:
        sys.exit(f"{finished.stdout}{finished.stderr}\nfailed with status {finished.returncode}")
    return finished.stdout


def the_only(pattern: str) -> Path:
    """Give the file of a pattern in dist/."""
    (found,) = DIST.glob(pattern)
    return found


def check_contents(wheel: Path, sdist: Path, folder: Path) -> None:
    """See that materials and types are in the wheel, and that the sdist makes the same wheel."""
    names = set(zipfile.ZipFile(wheel).namelist())
    wanted = {f"splatjax/_profiles/{path.name}" for path in (ROOT / "profiles").iterdir()} | {
        "splatjax/py.typed"
    }
    if missing := wanted - names:
        sys.exit(f"{wheel.name} lacks {', '.join(sorted(missing))}")
    if strange := {name for name in names if not name.startswith(("splatjax/", "splatjax-"))}:
        sys.exit(f"{wheel.name} holds {', '.join(sorted(strange))}")
    with tarfile.open(sdist) as archive:
        archive.extractall(folder, filter="data")
    run(
        _BIN / "hatchling",
        "build",
        "--target",
        "wheel",
        "--directory",
        folder,
        cwd=folder / sdist.name.removesuffix(".tar.gz"),
    )
    if set(zipfile.ZipFile(folder / wheel.name).namelist()) != names:
        sys.exit(f"{sdist.name} makes another wheel than the checkout")


def seconds(python: Path, module: str, folder: Path) -> float:
    """Give the least of five times that an import takes, with the start of Python; of the
    processor, which others use too.
    """
    spent = []
    for _ in range(5):
        begin = os.times()
        run(python, "-c", f"import {module}", cwd=folder)
        end = os.times()
        spent.append(
            end.children_user + end.children_system - begin.children_user - begin.children_system
        )
    return min(spent)


def main() -> None:
    """Build nothing, try everything."""
    wheel, sdist = the_only("*.whl"), the_only("*.tar.gz")
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        check_contents(wheel, sdist, folder)
        environment, empty = folder / "bare", folder / "empty"
        empty.mkdir()
        run(_BIN / "uv", "venv", "--quiet", "--python", sys.executable, environment, cwd=empty)
        python, splatjax = environment / "bin" / "python", environment / "bin" / "splatjax"
        run(_BIN / "uv", "pip", "install", "--quiet", "--python", python, wheel, cwd=empty)
        said = run(
            python,
            "-c",
            "import splatjax; print(splatjax.__file__, splatjax.__version__)",
            cwd=empty,
        ).split()
        if not Path(said[0]).is_relative_to(environment) or said[1] != wheel.name.split("-")[1]:
            sys.exit(f"not what was installed: {' '.join(said)}")
        jax, ours = (seconds(python, module, empty) for module in ("jax", "splatjax"))
        print(f"import jax {jax:.2f} s, import splatjax {ours:.2f} s")
        if ours - jax > LONGEST_IMPORT:
            sys.exit(
                f"import splatjax takes {ours - jax:.2f} s beyond jax's; at most {LONGEST_IMPORT} "
                "are allowed"
            )
        run(splatjax, "--help", cwd=empty)
        run(splatjax, "fit", "marble", "--output", "marble.toml", cwd=empty)
        program = re.search(
            r"```python\n(.*?)```", (ROOT / "README.md").read_text(encoding="utf-8"), re.DOTALL
        )
        assert program, "the README has no program"
        run(python, "-c", program[1], cwd=empty)
        made = sorted(path.name for path in empty.iterdir())
        if made != ["bust.exr", "bust.png", "marble.toml"]:
            sys.exit(f"made {', '.join(made)}")
    print(f"{wheel.name} and {sdist.name} work")


if __name__ == "__main__":
    main()
