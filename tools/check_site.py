"""Check of a built site what MkDocs does not: `python tools/check_site.py out/site`.

Every link and picture of every page leads to a file, and to a place in it that exists; and no page
fetches anything from elsewhere.
"""

import re
import sys
from html.parser import HTMLParser
from pathlib import Path
from urllib.parse import unquote, urldefrag

_FETCHED = {"script": "src", "img": "src", "source": "src", "iframe": "src", "link": "href"}
_NEVER_FETCHED = {"canonical", "alternate", "prev", "next"}


class _Page(HTMLParser):
    """The links of a page, whether each is fetched, and the places that can be linked to."""

    def __init__(self, path: Path):
        super().__init__()
        self.links: list[tuple[str, bool]] = []
        self.places: set[str] = set()
        self.feed(path.read_text(encoding="utf-8"))

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        values = {name: value for name, value in attrs if value}
        self.places |= {values[name] for name in ("id", "name") if name in values}
        link = values.get(_FETCHED.get(tag, "href" if tag == "a" else ""))
        if link:
            self.links.append((link, tag != "a" and values.get("rel") not in _NEVER_FETCHED))


def faults(site: Path) -> list[str]:
    """Return a line for each fault of a site."""
    pages = {path: _Page(path) for path in sorted(site.rglob("*.html"))}
    lines = [] if pages else [f"{site}: has no pages; build it first"]
    for path, page in pages.items():
        for link, fetched in page.links:
            where = f"{path.relative_to(site)}: {link}"
            if link.startswith(("https://", "http://", "//")):
                lines += [f"{where} is fetched from elsewhere"] if fetched else []
                continue
            if link.startswith(("data:", "mailto:", "javascript:")):
                continue
            target, place = urldefrag(link)
            base = site if target.startswith("/") else path.parent
            file = (base / unquote(target).lstrip("/")).resolve() if target else path
            file = file / "index.html" if file.is_dir() else file
            places = pages[file].places if file in pages else {unquote(place)}
            if not file.exists():
                lines.append(f"{where} leads nowhere")
            elif place and unquote(place) not in places and not place.startswith("__"):
                lines.append(f"{where}: there is no such place on that page")
    return lines + [
        f"{style.relative_to(site)} fetches from elsewhere"
        for style in sorted(site.rglob("*.css"))
        if re.search(r'url\("?http|@import', style.read_text(encoding="utf-8"))
    ]


if __name__ == "__main__":
    sys.exit("\n".join(faults(Path(sys.argv[1]).resolve())) or None)
