"""What MkDocs does besides: links to the sources, formulas without JavaScript, and a count of the
public names in the reference.

The pages stand in the repository too, where `../CONTRIBUTING.md` is a file. On the site such a link
leads to the repository. Formulas become MathML, which every browser draws without a network.
"""

import ast
import html
import logging
import posixpath
import re
import zlib
from pathlib import Path

from latex2mathml.converter import convert

log = logging.getLogger("mkdocs.hooks.gnio_jax")

LINK = re.compile(r"(?<=\]\()(\.\./[^)\s#]+)")
FORMULA = re.compile(
    r'<(span|div) class="arithmatex">\\[(\[](?P<latex>.*?)\\[)\]]</(?:span|div)>', re.S
)
UNKNOWN = re.compile(r"\\[a-zA-Z]+|&amp;|&#x00026;")
"""Of LaTeX, left over in MathML."""
NOTEBOOK_LINK = re.compile(r'href="\.\./([\w/]+)\.md')


def on_page_markdown(markdown, page, config, **_):
    """Links that leave docs/ lead to the repository."""
    root = Path(config["config_file_path"]).parent
    folder = posixpath.dirname(page.file.src_uri)

    def to_repository(match):
        path = posixpath.normpath(posixpath.join("docs", folder, match[1]))
        if path.startswith("docs/"):
            return match[1]
        if not (root / path).exists():
            log.warning(f"{page.file.src_uri}: link to '{match[1]}', which is not there")
        kind = "tree" if (root / path).is_dir() else "blob"
        return f"{config['repo_url']}/{kind}/main/{path}"

    return LINK.sub(to_repository, markdown)


def on_page_content(content, page, config, **_):
    """Formulas as MathML; the links of notebooks, which MkDocs does not know."""

    def mathml(match):
        latex = html.unescape(match["latex"])
        drawn = convert(latex, display="block" if match[1] == "div" else "inline")
        for command in UNKNOWN.findall(drawn):
            log.warning(f"{page.file.src_uri}: no MathML for '{command}' in {latex.strip()}")
        return drawn

    def to_page(match):
        if not (Path(config["docs_dir"]) / f"{match[1]}.md").is_file():
            log.warning(f"{page.file.src_uri}: link to '{match[1]}.md', which is not there")
        return f'href="../{match[1]}.html'

    if page.file.src_uri.startswith("notebooks/"):
        content = NOTEBOOK_LINK.sub(to_page, content)
    return FORMULA.sub(mathml, content)


def on_post_build(config, **_):
    """Every public name of a room has its place in the reference."""
    inventory = (Path(config["site_dir"]) / "objects.inv").read_bytes()
    lines = zlib.decompress(inventory.split(b"zlib.\n", 1)[1]).decode().splitlines()
    documented = {line.split(" ", 1)[0] for line in lines}
    package = Path(config["config_file_path"]).parent / "gnio_jax"
    for room in sorted(package.glob("*/__init__.py")):
        for name in public_names(room):
            # A function that has the name of its module is in the reference as that module's.
            places = {f"gnio_jax.{room.parent.name}.{path}" for path in (name, f"{name}.{name}")}
            if not places & documented:
                log.warning(f"gnio_jax.{room.parent.name}.{name} is not in the reference")


def public_names(module):
    """`__all__` of a module, read from its source."""
    for node in ast.parse(module.read_text(encoding="utf-8")).body:
        if isinstance(node, ast.Assign) and node.targets[0].id == "__all__":
            return ast.literal_eval(node.value)
    return []
