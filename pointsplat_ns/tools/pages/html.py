"""Renders HTML templates of this package to one file without external resources."""

from __future__ import annotations

import base64
import hashlib
import re
from collections.abc import Sequence
from functools import cache
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from jinja2 import Environment
    from markupsafe import Markup


@cache
def _environment() -> Environment:
    from jinja2 import Environment, PackageLoader, StrictUndefined

    environment = Environment(
        loader=PackageLoader("pointsplat_ns", "tools/pages/templates"),
        autoescape=True,
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    # Browsers reject JSON with NaN or infinity.
    environment.policies["json.dumps_kwargs"] = {
        "allow_nan": False,
        "ensure_ascii": False,
        "separators": (",", ":"),
    }
    return environment


def page(
    template: str, scripts: Sequence[str] = (), allowed: Sequence[str] = (), **values: Any
) -> bytes:
    """One HTML page, UTF-8, with embedded style, scripts and data, from a template that extends
    ``base.html``.

    The content security policy allows embedded pictures, and only the script and style of the page,
    by hash. Even unescaped text could not run code.

    Args:
        scripts: names of the scripts, in their order in the page.
        allowed: additional rules of the policy, such as ``worker-src blob:`` for workers.
        values: variables of the template. Texts are escaped; undecodable bytes of file names become
            "?".

    Raises:
        ValueError: if a number for a script is NaN or infinite.
    """
    from pointsplat_ns import __version__

    style = _source("style.css")
    script = "\n".join(_source(name) for name in scripts)
    rules = (
        "default-src 'none'",
        "img-src data:",
        f"style-src '{_hash(style)}'",
        f"script-src '{_hash(script)}'" if script else "script-src 'none'",
        *allowed,
        "base-uri 'none'",
        "form-action 'none'",
    )
    fixed = {"style": _unescaped(style), "script": _unescaped(script), "version": __version__}
    text = _environment().get_template(template).render(**fixed, policy="; ".join(rules), **values)
    return text.encode("utf-8", "replace")


def _source(name: str) -> str:
    """Text of a style or script of this package."""
    environment = _environment()
    assert environment.loader is not None
    return environment.loader.get_source(environment, name)[0]


def _unescaped(text: str) -> Markup:
    """A style or script of this package, unescaped: browsers do not decode entities in these
    elements."""
    from markupsafe import Markup

    assert not re.search(r"</s|<!--", text), "would end its element"
    return Markup(text)


def _hash(text: str) -> str:
    """Hash of an inline script or style for a content security policy."""
    digest = hashlib.sha256(text.encode("utf-8")).digest()
    return "sha256-" + base64.b64encode(digest).decode("ascii")
