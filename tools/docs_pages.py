"""Pages of the site that are written elsewhere: README, changelog, notebooks with their outputs,
and the API from its docstrings.

A hook of MkDocs (mkdocs.yml): `make docs` builds the site. Pages link to each other as files of the
repository, so that they can be read there too; here links are led to where the pages stand on the
site. `python tools/docs_pages.py FOLDER NOTEBOOK...` writes the pictures of executed notebooks.
"""

import base64
import dataclasses
import importlib
import inspect
import json
import pkgutil
import posixpath
import re
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import griffe
from latex2mathml.converter import convert
from mkdocs.config.defaults import MkDocsConfig
from mkdocs.structure.files import File, Files
from mkdocs.structure.pages import Page

ROOT = Path(__file__).resolve().parents[1]
MOVED = {
    "README.md": "index.md",
    "CHANGELOG.md": "changelog.md",
    "CONTRIBUTING.md": "contributing.md",
    "SECURITY.md": "security.md",
    "LICENSE": "license.txt",
    "CITATION.cff": "citation.cff",
    "notebooks": "notebooks/index.md",
}
# In the order in which a user needs them.
PACKAGES = (
    "scene",
    "io",
    "geometry",
    "render",
    "scattering",
    "gaussians",
    "fitting",
    "inverse",
    "splatting",
    "diffusion",
    "shading",
    "exports",
    "plots",
    "cache",
    "transport",
    "baselines",
)
GROUPS = {
    "Bodies": "bust sample_mesh read_splats write_splats Splats",
    "Materials": "list_materials load_material save_material Material",
    "Camera, lights and scene": "Camera DirectionalLight PointLight GaussianBeam EnvironmentLight "
    "Scene",
    "Pictures": "render RenderSettings Frame write_png write_exr read_exr",
    "Many pictures of one scene": "make_plan Plan illuminate transfer relighting_basis",
    "Fit a material": "load_medium Medium Layer Film load_profile Dipole LayeredMultipole "
    "SingleScattering fit_gaussians SumOfGaussians",
    "Derivatives and parts of a picture": "picture_jacobian PictureJacobian diffusion_basis "
    "DiffusionBasis compute_irradiance diffuse_irradiance",
    "Large scenes": "map_over render_streamed SplatFile",
}
_LINK = re.compile(r"(\]\()([^)#\s]+)(#[^)\s]*)?(\))")
_NOTEBOOK = re.compile(r"^(notebooks/.*)\.py$")
_MATHS = re.compile(r"\$([^$]+)\$")
# Up to the first period or empty line outside of code.
_FIRST_SENTENCE = re.compile(r"(?:`[^`]*`|(?!\n\n|(?<!Eq)(?<!\.)\.(?:\s|$)).)*", re.DOTALL)
_INLINE_CODE = re.compile(r"<code>[^<]*</code>")
_OPTION = re.compile(r"(?<![\w-])--[a-z][\w-]*")
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
    if here in ("index.md", "installation.md", "tour.md", "gallery.md"):
        page.meta["hide"] = ["navigation"]  # a page alone in its tab
    if here.startswith("api/") or here == MOVED["notebooks"]:
        return markdown
    sources = {place: source for source, place in MOVED.items()}
    source = here if here.startswith("notebooks/") else sources.get(here, f"docs/{here}")
    names = {f"splatjax.{each}.{name}" for each in PACKAGES for name in _public(f"splatjax.{each}")}

    def led(match: re.Match) -> str:
        opened, target, anchor, closed = match.groups()
        place = posixpath.normpath(posixpath.join(posixpath.dirname(source), target))
        if "://" in target or (here.startswith("notebooks/") and not place.startswith("docs/")):
            return match.group()  # of another site, or a picture of the notebook's own
        page = MOVED.get(place, _NOTEBOOK.sub(r"\1.md", place).removeprefix("docs/"))
        path = posixpath.relpath(page, posixpath.dirname(here) or ".")
        return f"{opened}{path}{anchor or ''}{closed}"

    parts = re.split(r"(^```.*?^```$)", _LINK.sub(led, markdown), flags=re.MULTILINE | re.DOTALL)
    parts[::2] = [
        _NAME.sub(lambda m: f"[{m[0]}][{m[1]}]" if m[1] in names else m[0], part)
        for part in parts[::2]
    ]
    return "".join(parts)


def on_page_content(html: str, **_: Any) -> str:
    """Keep options of the command line in one line: browsers break after each hyphen."""

    def whole(match: re.Match) -> str:
        return _OPTION.sub(r'<span class="option">\g<0></span>', match[0])

    return _INLINE_CODE.sub(whole, html)


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
            parts.append(_MATHS.sub(lambda m: f"<span>{convert(m[1])}</span>", source))
            continue
        code = re.sub(r"^%.*\n?|  # noqa: B018$", "", source, flags=re.MULTILINE)
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
    order = " ".join(GROUPS.values()).split()
    public = _public("splatjax")
    order += (others := [name for name in public if name not in order])
    lines = [
        "# API",
        "What `import splatjax as sj` gives. These names are stable; others may change.",
    ]
    for title, words in (*GROUPS.items(), *([("Others", " ".join(others))] if others else [])):
        lines += [f"## {title}", _table({name: public[name] for name in words.split()})]
    packages = {package: importlib.import_module(f"splatjax.{package}") for package in PACKAGES}
    lines += ["## Packages", _table(packages)]
    yield "api/index.md", "\n\n".join(lines) + "\n"
    for package, module in packages.items():
        values, home = _public(module.__name__), module.__name__
        names = sorted(
            values,
            key=lambda name: (
                order.index(name) if name in order else len(order),
                name.startswith("Abstract"),
            ),
        )
        table = _table({name: values[name] for name in names}, home)
        full = "\n\n".join(f"::: {home}.{name}" for name in names)
        yield f"api/{package}.md", f"# `{home}`\n\n{inspect.getdoc(module)}\n\n{table}\n\n{full}\n"


def _table(values: dict[str, Any], home: str = "") -> str:
    """Return a table of names, each with the first sentence of its documentation."""
    rows = ["| | |", "| --- | --- |"]
    for name, value in values.items():
        sentence = _FIRST_SENTENCE.match(inspect.getdoc(value) or "")[0]
        package = home or ".".join(getattr(value, "__module__", "").split(".")[:2])
        link = f"({name}.md)" if inspect.ismodule(value) else f"[{package}.{name}]"
        rows.append(f"| [`{name}`]{link} | {' '.join(sentence.split())} |")
    return "\n".join(rows)


def _public(module: str) -> dict[str, Any]:
    """Return the public functions and classes of a module, in the order of its exports: a package
    exports what it imports.
    """
    imported = importlib.import_module(module)
    home = "splatjax" if hasattr(imported, "__path__") else module
    return {
        name: value
        for name, value in vars(imported).items()
        if callable(value) and name[0] != "_" and value.__module__.startswith(home)
    }


class Constructors(griffe.Extension):
    """Adds the constructors of records, which equinox makes of their fields, and shows the values
    of defaults and types that a method inherits.
    """

    def on_class(self, *, cls: griffe.Class, **_: Any) -> None:
        record = pkgutil.resolve_name(cls.path)
        if "__init__" in cls.members or not dataclasses.is_dataclass(record):
            return
        factories = {
            field.name: field.default_factory
            for field in dataclasses.fields(record)
            if field.default_factory is not dataclasses.MISSING
        }
        parameters = [griffe.Parameter("self")]
        for name, given in inspect.signature(record).parameters.items():
            field = next(each.members[name] for each in [cls, *cls.mro()] if name in each.members)
            default = factories[name]() if name in factories else given.default
            value = _text(default) if "field(" in str(field.value) else field.value
            parameters.append(
                griffe.Parameter(
                    name,
                    annotation=field.annotation,
                    kind=griffe.ParameterKind(given.kind.description),
                    default=None if given.default is given.empty else value,
                )
            )
        made = griffe.Parameters(*parameters)
        cls.set_member("__init__", griffe.Function("__init__", parameters=made, parent=cls))

    def on_function(self, *, func: griffe.Function, **_: Any) -> None:
        for parameter in func.parameters:
            name = str(parameter.default)
            if name[0] == "_" and name.isidentifier():  # a private constant of the module
                parameter.default = _text(pkgutil.resolve_name(f"{func.module.path}.{name}"))
        if not isinstance(func.parent, griffe.Class):
            return
        for base in func.parent.mro():
            method = base.members.get(func.name)
            if not isinstance(method, griffe.Function):
                continue
            for parameter in func.parameters:
                if parameter.annotation is None and parameter.name in method.parameters:
                    parameter.annotation = method.parameters[parameter.name].annotation
            func.returns = func.returns or method.returns


def _text(value: Any) -> str:
    """Write a default as a user would: functions and classes by their names, long tuples
    shortened.
    """
    if callable(value) and hasattr(value, "__name__"):
        return value.__name__
    if isinstance(value, tuple) and len(value) > 8:
        return f"({value[0]!r}, {value[1]!r}, ..., {value[-1]!r})"
    if isinstance(value, float):
        return f"{value:.6g}" if value % 1 else repr(float(value))
    return repr(value)


if __name__ == "__main__":
    for executed in sys.argv[2:]:
        for picture, content in _notebook(Path(executed))[1].items():
            Path(sys.argv[1], picture).write_bytes(content)
