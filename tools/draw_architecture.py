"""Draw the house from its code: `python tools/draw_architecture.py` writes docs/images/architecture.svg.

Rooms stand in the order of the contract in pyproject.toml, each with its docstring; an arc is an import found in the code.
"""

import ast
import math
import tomllib
from html import escape
from pathlib import Path

from splatjax.io import atomic_path

ROOT = Path(__file__).resolve().parents[1]
OUTPUT = ROOT / "docs" / "images" / "architecture.svg"
ROW, LEFT, WIDTH, HEAD = 34, 250, 900, 52


def rooms() -> list[str]:
    """Give the rooms from the first to the last: each may import those before it."""
    contracts = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["tool"]["importlinter"]["contracts"]
    layers = next(contract["layers"] for contract in contracts if contract["type"] == "layers")
    return [layer.strip("()") for layer in reversed(layers)]


def files(room: str) -> list[Path]:
    """Give the source files of a room."""
    package = ROOT / "splatjax" / room
    return sorted(package.rglob("*.py")) if package.is_dir() else [package.with_suffix(".py")]


def imports(known: list[str]) -> list[tuple[str, str]]:
    """Give the pairs of rooms of which the first imports the second."""
    found = set()
    for room in known:
        for path in files(room):
            tree = ast.parse(path.read_text(encoding="utf-8"))
            found |= {(room, other) for node in ast.walk(tree) for other in _named(node) if other in known and other != room}
    return sorted(found)


def _named(node: ast.AST) -> list[str]:
    """Give what could be rooms among the names that a statement imports."""
    if isinstance(node, ast.ImportFrom) and not node.level and node.module == "splatjax":
        return [alias.name for alias in node.names]
    modules = [node.module] if isinstance(node, ast.ImportFrom) and not node.level and node.module else []
    if isinstance(node, ast.Import):
        modules = [alias.name for alias in node.names]
    return [module.split(".")[1] for module in modules if module.startswith("splatjax.")]


def said(room: str) -> str:
    """Give the first line of a room's docstring, without code marks."""
    return (ast.get_docstring(ast.parse(files(room)[0].read_text(encoding="utf-8"))) or "").partition("\n")[0].replace("`", "")


def drawn() -> str:
    """Give the picture as SVG."""
    order = rooms()
    places = {room: HEAD + ROW * i for i, room in enumerate(order)}
    height = HEAD + ROW * len(order)
    parts = [
        f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {WIDTH} {height}" font-family="sans-serif" font-size="12">',
        f'<rect width="{WIDTH}" height="{height}" fill="#fbf8f4"/>',
        '<text x="20" y="24" font-size="14" fill="#222">Data flows one way: a room imports those above it.</text>',
        '<text x="20" y="41" fill="#777">An arc leads from a room to one that it imports, in the color of that one.</text>',
    ]
    for room, other in imports(order):
        low, high = places[room] + ROW / 2, places[other] + ROW / 2
        bulge = LEFT - 14 - 200 * math.sqrt((low - high) / (ROW * len(order)))
        hue = round(360 * order.index(other) / len(order))
        parts.append(
            f'<path d="M{LEFT} {low:g} C{bulge:.0f} {low:g} {bulge:.0f} {high:g} {LEFT} {high:g}" fill="none" '
            f'stroke="hsl({hue} 45% 45%)" stroke-opacity="0.6" stroke-width="1.6"/>'
        )
    for i, (room, top) in enumerate(places.items()):
        hue = round(360 * i / len(order))
        box = f'x="{LEFT}" y="{top + 4}" width="110" height="{ROW - 8}" rx="4"'
        parts += [
            f'<rect {box} fill="hsl({hue} 45% 92%)" stroke="hsl({hue} 45% 45%)"/>',
            f'<text x="{LEFT + 10}" y="{top + 21}" font-weight="bold" fill="#222">{room}</text>',
            f'<text x="{LEFT + 122}" y="{top + 21}" fill="#333">{escape(_short(said(room)))}</text>',
        ]
    return "\n".join([*parts, "</svg>"]) + "\n"


def _short(text: str, most: int = 76) -> str:
    return text if len(text) <= most else text[: most - 1].rpartition(" ")[0] + " …"


if __name__ == "__main__":
    with atomic_path(OUTPUT) as temporary:
        temporary.write_text(drawn(), encoding="utf-8")
    print(OUTPUT.relative_to(ROOT))
