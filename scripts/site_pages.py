"""Hook of mkdocs.yml: pages from files outside docs/ and from notebooks, links as on GitHub."""

import json
import re
from os.path import dirname, join, normpath, relpath
from pathlib import Path

from mkdocs.structure.files import File, InclusionLevel

ROOT = Path(__file__).resolve().parents[1]
LINK = re.compile(r"(?<=\]\()(?![a-z]+:|#)([^)\s#]+)")
CODE = re.compile(r"(^```.*?^```$|^    .*?$)", re.M | re.S)
COLAB = "https://colab.research.google.com/github"


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
    if home.endswith(".ipynb"):
        repository = config.repo_url.removeprefix("https://github.com")
        places = {"Download the notebook": Path(home).name}
        if repository != config.repo_url:
            places["Open in Colab"] = f"{COLAB}{repository}/blob/main/{home}"
        markdown = format_notebook(json.loads(markdown), places)

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


def format_notebook(notebook, places):
    """Return the cells of a notebook and their outputs as Markdown; below the title links to
    `places`, {words: address}."""
    links = " · ".join(f'<a href="{address}">{words}</a>' for words, address in places.items())
    parts = []
    for cell in notebook["cells"]:
        text = "".join(cell["source"])
        parts.append(text if cell["cell_type"] == "markdown" else f"```python\n{text}\n```")
        parts += map(_format_output, cell.get("outputs", ()))
    title, rest = "\n\n".join(parts).split("\n", 1)
    return f"{title}\n\n{links}\n{rest}\n"


def _format_output(output):
    shown = output.get("data", {})
    for kind in (kind for kind in shown if kind.startswith("image/")):
        data = "".join(shown[kind]).strip()
        return f'<img alt="picture that the cell above draws" src="data:{kind};base64,{data}">'
    if "text/html" in shown:
        return "".join(shown["text/html"])
    text = "".join(output.get("text") or shown["text/plain"]).strip()
    return f"```output\n{text}\n```"
