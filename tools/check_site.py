"""Hold a built site to what MkDocs does not check: `python tools/check_site.py out/site`.

Every link and picture of every page leads to a file, and to a place in it that exists; and no page
fetches anything from elsewhere.
"""

import sys
from html.parser import HTMLParser
from pathlib import Path
from urllib.parse import unquote, urldefrag

_FETCHED = {
    ("script", "src"),
    ("img", "src"),
    ("source", "src"),
    ("iframe", "src"),
    ("link", "href"),
}
_FOLLOWED = {("a", "href"), *_FETCHED}
_NEVER_FETCHED = {"canonical", "alternate", "prev", "next"}


class _Page(HTMLParser):
    """What a page links to, and the places in it that can be linked to."""

    def __init__(self, path: Path):
        super().__init__()
        self.links: list[tuple[str, bool]] = []
        self.places: set[str] = set()
        self.feed(path.read_text(encoding="utf-8"))

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        named = dict(attrs)
        self.places |= {value for value in (named.get("id"), named.get("name")) if value}
        for name, value in attrs:
            if value and (tag, name) in _FOLLOWED:
                self.links.append(
                    (value, (tag, name) in _FETCHED and named.get("rel") not in _NEVER_FETCHED)
                )


def faults(site: Path) -> list[str]:
    """Give what is wrong with a site, a line for each."""
    pages = {path: _Page(path) for path in sorted(site.rglob("*.html"))}
    found = [f"{site}: has no pages; build it first"] if not pages else []
    for path, page in pages.items():
        for link, fetched in page.links:
            where = f"{path.relative_to(site)}: {link}"
            if link.startswith(("https://", "http://", "//")):
                if fetched:
                    found.append(f"{where} is fetched from elsewhere")
                continue
            if link.startswith(("data:", "mailto:", "javascript:")):
                continue
            target, place = urldefrag(link)
            base = site if target.startswith("/") else path.parent
            led = path if not target else (base / unquote(target).lstrip("/")).resolve()
            if led.is_dir():
                led = led / "index.html"
            if not led.exists():
                found.append(f"{where} leads nowhere")
            elif (
                place
                and led in pages
                and unquote(place) not in pages[led].places
                and not place.startswith("__")
            ):
                found.append(f"{where}: there is no such place on that page")
    for style in sorted(site.rglob("*.css")):
        text = style.read_text(encoding="utf-8")
        if any(way in text for way in ("url(http", 'url("http', "@import")):
            found.append(f"{style.relative_to(site)} fetches from elsewhere")
    return found


if __name__ == "__main__":
    wrong = faults(Path(sys.argv[1]).resolve())
    print(*wrong, sep="\n")
    sys.exit(bool(wrong))
