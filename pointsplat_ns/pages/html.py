"""HTML from the templates of this package, as one file that loads nothing."""

from __future__ import annotations

import base64
import hashlib
import re
from functools import cache
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from jinja2 import Environment
    from markupsafe import Markup


@cache
def _environment() -> Environment:
    from jinja2 import Environment, PackageLoader, StrictUndefined

    environment = Environment(
        loader=PackageLoader("pointsplat_ns", "pages/templates"),
        autoescape=True,
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    # JSON has no NaN and no infinity: a browser would refuse all of the data.
    environment.policies["json.dumps_kwargs"] = {"allow_nan": False, "ensure_ascii": False, "separators": (",", ":")}
    return environment


def page(template: str, scripts: tuple[str, ...] = (), *, with_workers: bool = False, **values: Any) -> str:
    """One HTML page with its style, scripts and data in it.

    Its policy (CSP) lets a browser run and apply the script and style that are named by their hashes and show pictures
    that are in the page, and load nothing else: a text that slipped through the escaping could do nothing.

    Args:
        template: name of a template that extends ``base.html``.
        scripts: names of the scripts to put in, in this order.
        with_workers: let the scripts start workers, whose programs are parts of them.
        values: what the template shows. Texts are escaped; bytes of a file's name that are no characters become "?".

    Raises:
        ValueError: if a value that the template gives to a script is NaN or infinite.
    """
    from pointsplat_ns import __version__

    style = _source("style.css")
    script = "\n".join(_source(name) for name in scripts)
    rules = (
        "default-src 'none'",
        "img-src data:",
        f"style-src '{_hash(style)}'",
        f"script-src '{_hash(script)}'" if script else "script-src 'none'",
        *(("worker-src blob:",) if with_workers else ()),
        "base-uri 'none'",
        "form-action 'none'",
    )
    fixed = {"style": _as_it_is(style), "script": _as_it_is(script), "policy": "; ".join(rules), "version": __version__}
    text = _environment().get_template(template).render(**fixed, **values)
    return text.encode("utf-8", "replace").decode("utf-8")


def _source(name: str) -> str:
    """The text of a style or script of this package."""
    environment = _environment()
    assert environment.loader is not None
    return environment.loader.get_source(environment, name)[0]


def _as_it_is(text: str) -> Markup:
    """A style or script of our own, not to be escaped: a browser does not read entities within these elements."""
    from markupsafe import Markup

    assert not re.search(r"</s|<!--", text), "would end its element"
    return Markup(text)


def _hash(text: str) -> str:
    """The name of an inline script or style in a content security policy."""
    return "sha256-" + base64.b64encode(hashlib.sha256(text.encode("utf-8")).digest()).decode("ascii")
