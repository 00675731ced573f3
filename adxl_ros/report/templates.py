# SPDX-License-Identifier: Apache-2.0

"""Templates of the files that the package writes."""

from __future__ import annotations

from typing import TYPE_CHECKING

from adxl_ros.errors import install_hint, UserError

if TYPE_CHECKING:
    from jinja2 import Environment


def environment(purpose: str, *folders: tuple[str, str], escapes: bool = True) -> Environment:
    """
    Return the templates of some folders, which are pairs of package and folder.

    A missing value is an error. `escapes` is for HTML and XML. Raise UserError without jinja2.
    """
    try:
        from jinja2 import ChoiceLoader, Environment, PackageLoader, StrictUndefined
    except ImportError:
        raise UserError(f'{purpose} needs jinja2: {install_hint("jinja2")}') from None
    loader = ChoiceLoader([PackageLoader(package, folder) for package, folder in folders])
    return Environment(
        loader=loader,
        autoescape=escapes,
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
        keep_trailing_newline=True,
    )
