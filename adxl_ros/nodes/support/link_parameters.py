# SPDX-License-Identifier: Apache-2.0

"""The parameters of the driver that choose its link; no real unit gets simulated data."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

from adxl_ros.files.stream_info import NO_UNIT
from adxl_ros.links.support import base
from adxl_ros.nodes.support.parameters import declare, nearest, parameter_error
from adxl_ros.nodes.support.rclpy_internals import given_parameters
from rclpy.node import Node

PREFIX = 'link.'
"""Begin of the names of all parameters of a link; the driver alone has them."""
LINK_TYPE = 'link.type'
"""Parameter that chooses the link."""


class ChosenLink(NamedTuple):
    """The link that the parameters choose."""

    name: str  # Value of `link.type`
    module: base.LinkModule  # Module of the link
    settings: Any  # Instance of the module's `Settings`


def declare_link(node: Node, serial: str) -> ChosenLink:
    """Declare the parameters of the link."""
    given = [name for name, _ in given_parameters(node) if name.startswith(PREFIX)]
    if LINK_TYPE not in given:
        _refuse_to_guess(given, serial)
    name = declare(node, LINK_TYPE, base.DEFAULT_LINK, 'where the samples come from',
                   choices=base.link_names())
    module = base.link_module(name)
    options = base.options(module.Settings)
    _refuse_unknown(given, name, [LINK_TYPE, *(f'{PREFIX}{option.name}' for option in options)])
    return ChosenLink(name, module, module.Settings(**{
        option.name: declare(node, f'{PREFIX}{option.name}', option.default, option.doc,
                             option.unit, option.lower, option.upper)
        for option in options}))


def given_link(node: Node) -> dict[str, Any]:
    """Return the given parameters of the link by name, for a file that carries them."""
    return {name.removeprefix(PREFIX): value for name, value in given_parameters(node)
            if name.startswith(PREFIX)}


def _refuse_to_guess(given: Sequence[str], serial: str) -> None:
    """Refuse the default link, which simulates, where the parameters mean a real sensor."""
    links = _links_by_parameter()
    for name in given:
        if name not in links:
            raise parameter_error(name, f'is no parameter of any link; did you mean '
                                  f'{nearest(name, [LINK_TYPE, *links])}?')
    reason = f'the sensor is the unit {serial}' if serial != NO_UNIT else ''
    if given:
        reason = f'{given[0]} is given'
    if reason:
        devices = [name for name in base.link_names() if name != base.DEFAULT_LINK]
        raise parameter_error(LINK_TYPE, f'is not set, but {reason}; set it to '
                              f'{", ".join(devices)}, or to {base.DEFAULT_LINK} for a '
                              'simulated sensor')


def _refuse_unknown(given: Sequence[str], link: str, declared: Sequence[str]) -> None:
    """Refuse parameters that the chosen link does not have."""
    for name in given:
        if name in declared:
            continue
        links = _links_by_parameter()
        if name in links:
            raise parameter_error(name, f'the link {link} has no such parameter; {LINK_TYPE} '
                                  f'{" or ".join(links[name])} has it')
        raise parameter_error(name, f'the link {link} has no such parameter; did you mean '
                              f'{nearest(name, declared)}?')


def _links_by_parameter() -> dict[str, list[str]]:
    """Return the links that have a parameter, by its name."""
    links: dict[str, list[str]] = {}
    for link in base.link_names():
        for option in base.options(base.link_module(link).Settings):
            links.setdefault(f'{PREFIX}{option.name}', []).append(link)
    return links
