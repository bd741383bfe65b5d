"""Hook of mkdocs.yml: pages of the site from files outside docs/, links as on GitHub."""

import re
from os.path import dirname, join, normpath, relpath
from pathlib import Path

from mkdocs.structure.files import File, InclusionLevel

ROOT = Path(__file__).resolve().parents[1]
LINK = re.compile(r"(?<=\]\()(?![a-z]+:|#)([^)\s#]+)")
CODE = re.compile(r"(^```.*?^```$|^    .*?$)", re.M | re.S)


def on_files(files, config):
    """Add the pages and lists of mkdocs.yml, the cards of the weights and their plots."""
    cards = [path for path in ROOT.glob("weights/**/*") if path.suffix in (".md", ".png")]
    sources = {path.relative_to(ROOT).as_posix(): path for path in cards}
    sources |= {uri: ROOT / path for path, uri in config.extra["pages"].items()}
    for uri, path in sources.items():
        kind = {"abs_src_path": str(path), "inclusion": InclusionLevel.NOT_IN_NAV}
        files.append(File.generated(config, uri, **kind))
    for folder, title in config.extra["lists"].items():
        pages, home = sorted((ROOT / folder).rglob("*.md")), ROOT / folder
        heads = {page: page.read_text("utf-8").split("\n", 1)[0][2:] for page in pages}
        lines = [f"- [{head}]({page.relative_to(home)})\n" for page, head in heads.items()]
        uri = f"{folder.removeprefix('docs/')}/index.md"
        files.append(File.generated(config, uri, content=f"# {title}\n\n{''.join(lines)}"))
    return files


def on_page_markdown(markdown, page, config, files):
    """Return the text with links that lead to the same page or file as on GitHub.

    A file that is no page is in the repository at repo_url; without it in this folder.
    """
    uri, pages = page.file.src_uri, config.extra["pages"]
    sources = {site: path for path, site in pages.items()}
    home = sources.get(uri, uri if uri.startswith("weights/") else f"docs/{uri}")

    def rewrite(link):
        path = normpath(join(dirname(home), link[1]))
        target = pages.get(path, path.removeprefix("docs/"))
        for place in (target, f"{target}/index.md"):
            if files.get_file_from_path(place):
                return relpath(place, dirname(uri))
        if not (ROOT / path).exists():
            return link[1]  # a strict build refuses it
        return f"{config.repo_url}/blob/main/{path}" if config.repo_url else (ROOT / path).as_uri()

    parts = CODE.split(markdown)  # text, code, text ...
    return "".join(part if n % 2 else LINK.sub(rewrite, part) for n, part in enumerate(parts))
