"""Pages of the site that are written elsewhere: README, changelog, notebooks with their outputs,
and the API from its docstrings.

A hook of MkDocs (mkdocs.yml): `make docs` builds the site. Pages link to each other as files of the
repository, so that they can be read there too; here links are led to where the pages stand on the
site. `python tools/docs_pages.py FOLDER NOTEBOOK...` writes the pictures of executed notebooks.
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
MOVED = {
    "README.md": "index.md",
    "CHANGELOG.md": "changelog.md",
    "CONTRIBUTING.md": "contributing.md",
    "LICENSE": "license.txt",
    "CITATION.cff": "citation.cff",
    "notebooks": "notebooks/index.md",
}
PACKAGES = (
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
    "cache",
    "plots",
)
_LINK = re.compile(r"(\]\()([^)#\s]+)(#[^)\s]*)?(\))")
_MATHS = re.compile(r"\$([^$\n]+)\$")
_NAME = re.compile(r"(?<!\[)`(splatjax(?:\.\w+)+)`(?!\])")


def on_files(files: Files, config: MkDocsConfig) -> Files:
    """Add what does not stand in docs/."""
    texts = [
        (place, (ROOT / source).read_text(encoding="utf-8"))
        for source, place in MOVED.items()
        if (ROOT / source).is_file()
    ]
    for place, content in (*texts, *_notebook_pages(), *_api_pages()):
        files.append(File.generated(config, place, content=content))
    return files


def on_page_markdown(markdown: str, page: Page, config: MkDocsConfig, files: Files) -> str:
    """Lead links to the places that pages have on the site, and names of the library to their
    documentation.
    """
    here = page.file.src_uri
    if here in ("index.md", "tour.md", "gallery.md"):
        page.meta["hide"] = ["navigation"]  # a page alone in its tab
    if here.startswith("api/") or here == MOVED["notebooks"]:
        return markdown
    sources = {place: source for source, place in MOVED.items()}
    source = here if here.startswith("notebooks/") else sources.get(here, f"docs/{here}")
    names = _documented()

    def led(match: re.Match) -> str:
        opened, target, anchor, closed = match.groups()
        place = posixpath.normpath(posixpath.join(posixpath.dirname(source), target))
        own_picture = here.startswith("notebooks/") and not place.startswith("docs/")
        if "://" in target or own_picture:
            return match.group()
        path = posixpath.relpath(_place(place), posixpath.dirname(here) or ".")
        return f"{opened}{path}{anchor or ''}{closed}"

    def named(match: re.Match) -> str:
        return f"[{match[0]}][{match[1]}]" if match[1] in names else match[0]

    parts = re.split(r"(^```.*?^```$)", _LINK.sub(led, markdown), flags=re.MULTILINE | re.DOTALL)
    parts[::2] = [_NAME.sub(named, part) for part in parts[::2]]
    return "".join(parts)


def _place(source: str) -> str:
    """Return the place on the site of a file of the repository."""
    is_notebook = source.startswith("notebooks/")
    page = source.removesuffix(".py") + ".md" if is_notebook else source.removeprefix("docs/")
    return MOVED.get(source, page)


def _notebook_pages() -> Iterator[tuple[str, str | bytes]]:
    """Yield a page for each executed notebook, its pictures, and a list of all."""
    lines = [
        "# Notebooks",
        "",
        "Each ends with a claim that it asserts; the tests run them. `make notebooks` opens them.",
        "",
    ]
    for path in sorted((ROOT / "out" / "notebooks").glob("*.ipynb")):
        text, pictures = _notebook(path)
        yield f"notebooks/{path.stem}.md", text
        yield from ((f"notebooks/{name}", data) for name, data in pictures.items())
        lines.append(f"- [{text.partition(chr(10))[0].lstrip('# ')}]({path.stem}.md)")
    yield "notebooks/index.md", "\n".join(lines) + "\n"


def _notebook(path: Path) -> tuple[str, dict[str, bytes]]:
    """Return a notebook as Markdown, and the pictures it shows by their names."""
    parts, pictures = [], {}
    for cell in json.loads(path.read_text(encoding="utf-8"))["cells"]:
        source = "".join(cell["source"])
        if cell["cell_type"] == "markdown":  # browsers show MathML without a script
            parts.append(_MATHS.sub(lambda m: convert(m[1]), source))
            continue
        lines = [line for line in source.splitlines() if not line.startswith("%")]
        code = "\n".join(line.removesuffix("  # noqa: B018") for line in lines)
        parts.append(f"```python\n{code}\n```")
        for output in cell["outputs"]:
            data = output.get("data", {})
            if "image/png" in data:
                name = f"{path.stem}{f'_{len(pictures) + 1}' if pictures else ''}.png"
                pictures[name] = base64.b64decode("".join(data["image/png"]))
                parts.append(f"![what the cell above draws]({name})")
            elif "text" in output and output.get("name") != "stderr":
                parts.append(f"```text\n{''.join(output['text']).rstrip()}\n```")
    parts.insert(1, f"This page is `notebooks/{path.stem}.py`, run when the site was built.")
    return "\n\n".join(parts) + "\n", pictures


def _api_pages() -> Iterator[tuple[str, str]]:
    """Yield a page for each package, and a list of what `import splatjax` gives."""
    rows = []
    for node in ast.parse((ROOT / "splatjax" / "__init__.py").read_text(encoding="utf-8")).body:
        if isinstance(node, ast.ImportFrom) and node.module:
            rows += [(name.name, f"splatjax.{node.module}", node.module) for name in node.names]
    known = _documented()
    lines = ["| | package |", "| --- | --- |"]
    for name, package, module in sorted(rows):
        link = f"[`{name}`][{package}.{name}]" if f"{package}.{name}" in known else f"`{name}`"
        lines.append(f"| {link} | [`{package}`]({module}.md) |")
    intro = "What `import splatjax as sj` gives. These names are stable; everything else may move."
    more = ", ".join(f"[`{package}`]({package}.md)" for package in PACKAGES)
    table = "\n".join(lines)
    yield "api/index.md", f"# API\n\n{intro} Packages hold more: {more}.\n\n{table}\n"
    for package in PACKAGES:
        names = "\n".join(f"::: splatjax.{package}.{name}\n" for name in _exports(package))
        text = ast.get_docstring(ast.parse(_source(package).read_text(encoding="utf-8")))
        yield f"api/{package}.md", f"# `splatjax.{package}`\n\n{text}\n\n{names}"


def _documented() -> set[str]:
    return {f"splatjax.{package}.{name}" for package in PACKAGES for name in _exports(package)}


def _source(package: str) -> Path:
    path = ROOT / "splatjax" / package
    return path / "__init__.py" if path.is_dir() else path.with_suffix(".py")


def _exports(package: str) -> list[str]:
    """Return the public names of a package, in the order in which it exports or defines them."""
    names, path = [], _source(package)
    for node in ast.parse(path.read_text(encoding="utf-8")).body:
        if isinstance(node, ast.ImportFrom) and node.level and path.name == "__init__.py":
            names += [name.asname for name in node.names if name.asname]
        elif isinstance(node, ast.FunctionDef | ast.ClassDef):
            names.append(node.name)
    return [name for name in names if not name.startswith("_") and not name.isupper()]


if __name__ == "__main__":
    folder = Path(sys.argv[1])
    folder.mkdir(parents=True, exist_ok=True)
    for executed in sys.argv[2:]:
        for name, data in _notebook(Path(executed))[1].items():
            (folder / name).write_bytes(data)
