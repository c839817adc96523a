"""The page and its parts, filled in."""

from typing import Any

from jinja2 import Environment, PackageLoader, StrictUndefined
from markupsafe import Markup

_ENVIRONMENT = Environment(
    loader=PackageLoader("kronc_ns.show.report", "."), autoescape=True, undefined=StrictUndefined, trim_blocks=True,
    lstrip_blocks=True,
)  # fmt: skip


def render(name: str, **values: Any) -> str:
    """The template ``name`` with its values, which are escaped unless they are `Markup`."""
    return _ENVIRONMENT.get_template(name).render(values)


def source(name: str) -> Markup:
    """A file of ours as it is."""
    assert _ENVIRONMENT.loader is not None
    return Markup(_ENVIRONMENT.loader.get_source(_ENVIRONMENT, name)[0])
