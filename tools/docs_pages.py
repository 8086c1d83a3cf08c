"""Pages of the site that are written elsewhere: README, changelog, notebooks with their outputs,
and the API from its docstrings.

A hook of MkDocs (mkdocs.yml): `make docs` builds the site. Pages link to each other as files of the
repository, so that they can be read there too; here links are led to where the pages stand on the
site.
"""

import ast
import base64
import json
import posixpath
import re
import sys
from collections.abc import Iterator
from pathlib import Path

from latex2mathml.converter import convert
from mkdocs.config.defaults import MkDocsConfig
from mkdocs.structure.files import File, Files
from mkdocs.structure.pages import Page

ROOT = Path(__file__).resolve().parents[1]
EXECUTED = ROOT / "out" / "notebooks"
MOVED = {
    "README.md": "index.md",
    "CHANGELOG.md": "changelog.md",
    "CONTRIBUTING.md": "contributing.md",
    "LICENSE": "license.txt",
    "CITATION.cff": "citation.cff",
    "notebooks": "notebooks/index.md",
}
ROOMS = (
    "gaussians",
    "scattering",
    "fitting",
    "transport",
    "scene",
    "geometry",
    "splatting",
    "diffusion",
    "shading",
    "render",
    "inverse",
    "baselines",
    "exports",
    "io",
    "plots",
    "pointwise",
    "devices",
)
_LINK = re.compile(r"(\]\()([^)#\s]+)(#[^)\s]*)?(\))")
_MATHS = re.compile(r"\$([^$\n]+)\$")
_NAME = re.compile(r"(?<!\[)`(splatjax(?:\.\w+)+)`(?!\])")


def on_files(files: Files, config: MkDocsConfig) -> Files:
    """Add what does not stand in docs/."""
    for source, place in MOVED.items():
        if (ROOT / source).is_file():
            files.append(
                File.generated(config, place, content=(ROOT / source).read_text(encoding="utf-8"))
            )
    for place, content in (*_notebook_pages(), *_api_pages()):
        files.append(File.generated(config, place, content=content))
    return files


def on_page_markdown(markdown: str, page: Page, config: MkDocsConfig, files: Files) -> str:
    """Lead links to the places that pages have on the site, and names of the library to what is
    said of them.
    """
    here = page.file.src_uri
    if here in ("index.md", "tour.md", "gallery.md"):
        page.meta["hide"] = ["navigation"]  # a page alone in its tab
    written = next((source for source, place in MOVED.items() if place == here), f"docs/{here}")
    if here.startswith("api/") or here == MOVED["notebooks"]:
        return markdown
    if here.startswith("notebooks/"):
        written = here
    names = _documented()

    def led(match: re.Match) -> str:
        opened, target, anchor, closed = match.groups()
        if "://" in target:
            return match.group()
        place = posixpath.normpath(posixpath.join(posixpath.dirname(written), target))
        if here.startswith("notebooks/") and not place.startswith("docs/"):
            return match.group()  # its own pictures
        path = posixpath.relpath(_place(place), posixpath.dirname(here) or ".")
        return f"{opened}{path}{anchor or ''}{closed}"

    parts = re.split(r"(^```.*?^```$)", _LINK.sub(led, markdown), flags=re.MULTILINE | re.DOTALL)
    parts[::2] = [
        _NAME.sub(lambda m: f"[{m[0]}][{m[1]}]" if m[1] in names else m[0], part)
        for part in parts[::2]
    ]
    return "".join(parts)


def _place(source: str) -> str:
    """Give the place on the site of a file of the repository."""
    if source in MOVED:
        return MOVED[source]
    if source.startswith("notebooks/"):
        return source.removesuffix(".py") + ".md"
    return source.removeprefix("docs/")


def _notebook_pages() -> Iterator[tuple[str, str | bytes]]:
    """Give a page for each executed notebook, its pictures, and a list of all."""
    listed = [
        "# Notebooks",
        "",
        "Each ends with a claim that it asserts; the tests run them. `make notebooks` opens them.",
        "",
    ]
    for path in sorted(EXECUTED.glob("*.ipynb")):
        text, pictures = _notebook(path)
        yield f"notebooks/{path.stem}.md", text
        yield from ((f"notebooks/{name}", data) for name, data in pictures.items())
        listed.append(f"- [{text.partition(chr(10))[0].lstrip('# ')}]({path.stem}.md)")
    yield "notebooks/index.md", "\n".join(listed) + "\n"


def _notebook(path: Path) -> tuple[str, dict[str, bytes]]:
    """Give a notebook as Markdown, and the pictures it shows by their names."""
    parts, pictures = [], {}
    for cell in json.loads(path.read_text(encoding="utf-8"))["cells"]:
        source = "".join(cell["source"])
        if cell["cell_type"] == "markdown":
            parts.append(
                _MATHS.sub(lambda m: convert(m[1]), source)
            )  # browsers show MathML without a script
            continue
        shown = "\n".join(
            line.removesuffix("  # noqa: B018")
            for line in source.splitlines()
            if not line.startswith("%")
        )
        parts.append(f"```python\n{shown}\n```")
        for output in cell["outputs"]:
            data = output.get("data", {})
            if "image/png" in data:
                name = f"{path.stem}_{len(pictures) + 1}.png"
                pictures[name] = base64.b64decode("".join(data["image/png"]))
                parts.append(f"![what the cell above draws]({name})")
            elif "text" in output and output.get("name") != "stderr":
                parts.append(f"```text\n{''.join(output['text']).rstrip()}\n```")
    title, *rest = parts
    parts = [title, f"This page is `notebooks/{path.stem}.py`, run when the site was built.", *rest]
    return "\n\n".join(parts) + "\n", pictures


def _api_pages() -> Iterator[tuple[str, str]]:
    """Give a page for each room, and a list of what `import splatjax` gives."""
    yield "api/index.md", _surface()
    for room in ROOMS:
        names = "\n".join(f"::: splatjax.{room}.{name}\n" for name in _exports(room))
        said = ast.get_docstring(ast.parse(_source(room).read_text(encoding="utf-8")))
        yield f"api/{room}.md", f"# `splatjax.{room}`\n\n{said}\n\n{names}"


def _surface() -> str:
    rows = []
    for node in ast.parse((ROOT / "splatjax" / "__init__.py").read_text(encoding="utf-8")).body:
        if isinstance(node, ast.ImportFrom):
            rows += [(name.name, f"splatjax.{node.module}.{name.name}") for name in node.names]
    known = _documented()
    lines = [
        f"| {f'[`{name}`][{path}]' if path in known else f'`{name}`'} | "
        f"[`{path.rpartition('.')[0]}`]({path.split('.')[1]}.md) |"
        for name, path in sorted(rows)
    ]
    intro = "What `import splatjax as sj` gives. These names are stable; everything else may move."
    rooms = ", ".join(f"[`{room}`]({room}.md)" for room in ROOMS)
    table = "\n".join(["| | room |", "| --- | --- |", *lines])
    return f"# API\n\n{intro} Rooms hold more: {rooms}.\n\n{table}\n"


def _documented() -> set[str]:
    return {f"splatjax.{room}.{name}" for room in ROOMS for name in _exports(room)}


def _source(room: str) -> Path:
    package = ROOT / "splatjax" / room
    return package / "__init__.py" if package.is_dir() else package.with_suffix(".py")


def _exports(room: str) -> list[str]:
    """Give the public names of a room, in the order in which it exports or defines them."""
    names = []
    for node in ast.parse(_source(room).read_text(encoding="utf-8")).body:
        if isinstance(node, ast.ImportFrom) and node.level and _source(room).name == "__init__.py":
            names += [name.asname for name in node.names if name.asname]
        elif isinstance(node, ast.FunctionDef | ast.ClassDef):
            names.append(node.name)
    return [name for name in names if not name.startswith("_") and not name.isupper()]


if __name__ == "__main__":  # out/figures NOTEBOOK...: write the pictures of executed notebooks
    folder = Path(sys.argv[1])
    folder.mkdir(parents=True, exist_ok=True)
    for executed in map(Path, sys.argv[2:]):
        for name, data in _notebook(executed)[1].items():
            (folder / name.replace("_1.png", ".png")).write_bytes(data)
            print(folder / name.replace("_1.png", ".png"))
