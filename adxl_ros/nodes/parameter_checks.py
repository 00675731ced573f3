# SPDX-License-Identifier: Apache-2.0

"""What a node is started with: parameters that no node has are refused, and refusals explained."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from difflib import get_close_matches
from importlib import import_module
import re
import sys

from adxl_ros.errors import one_line
from adxl_ros.nodes.parameters import given_parameters, LINK, node_specs
from adxl_ros.nodes.params_files import check_sections, parameter_error
from adxl_ros.nodes.sensor_parameters import sensor_specs
from adxl_ros.process import NODES
from rcl_interfaces import msg
from rclpy.node import Node
from rclpy.parameter import Parameter

_ANY_NODE = ('use_sim_time', 'start_type_description_service')  # Parameters of every node of rclpy
_QOS = 'qos_overrides.'  # Begin of the names of parameters that override the QoS of a topic
_FREE_PREFIXES = ('provenance.', LINK)
"""Prefixes whose names are not known here: free keys, and what the driver checks."""
QOS_POLICIES = ('history', 'depth', 'reliability', 'durability')
"""Policies that parameters can override: those that a publisher and a subscription share."""
_QOS_NAME = re.compile(rf'{_QOS}(/.+)\.(publisher|subscription)\.({"|".join(QOS_POLICIES)})')
_READ_ONLY = 'read-only'  # Word of rclpy's refusal
_DIAGNOSTICS = '/diagnostics'  # The only topic of a node that is not configured


def check_given(node: Node) -> None:
    """Refuse parameters that no node of this package has, and files that name other nodes."""
    check_sections(node.get_fully_qualified_name())
    own = (*sensor_specs(), *node_specs(sys.modules[type(node).__module__]))
    known = {*_ANY_NODE, *(spec.name for spec in own)}
    # One file may serve all nodes: a node ignores what another one has. The others are loaded one
    # after the other, and only until one has the name.
    broken: list[str] = []
    others = _names_of_nodes(broken)
    for name in given_parameters(node):
        if name.startswith(_QOS) and not _QOS_NAME.fullmatch(name):
            raise parameter_error(
                name,
                f'expected {_QOS}/TOPIC.ENTITY.POLICY, ENTITY publisher '
                f'or subscription, POLICY {", ".join(QOS_POLICIES)}',
            )
        if name.startswith((*_FREE_PREFIXES, _QOS)):
            continue
        while name not in known:
            other = next(others, None)
            if other is None:
                like = get_close_matches(name, sorted(known), 1, 0.0)[0]
                unread = f' ({"; ".join(broken)})' if broken else ''
                raise parameter_error(
                    name, f'no node has a parameter of this name{unread}; did you mean {like}?'
                )
            known.add(other)


def _names_of_nodes(broken: list[str]) -> Iterator[str]:
    """Yield the parameters of all nodes; add what is wrong with those that do not load."""
    for node in NODES:
        try:
            module = import_module(f'adxl_ros.nodes.{node}')
        # A fault of another node, whatever it is, must not hide the misspelt name of this one.
        except Exception as error:
            broken.append(f'{node} does not load: {one_line(error)}')
            continue
        yield from (spec.name for spec in node_specs(module))


def warn_of_unused_qos(node: Node) -> None:
    """Warn of the given QoS of topics that a node does not have; other nodes may have them."""
    own = _topics_of_qos(node._parameters)
    unused = _topics_of_qos(given_parameters(node)) - own
    if own != {_DIAGNOSTICS} and unused:
        node.get_logger().warning(
            f'qos_overrides of {", ".join(sorted(unused))}: not used; the topics of this '
            f'node are {", ".join(sorted(own))}'
        )


def _topics_of_qos(names: Iterable[str]) -> set[str]:
    """Return the topics whose QoS parameters override."""
    return {match[1] for match in map(_QOS_NAME.fullmatch, names) if match}


def explain_read_only(node: Node) -> None:
    """Let the refusal of a read-only parameter say how it can be given; rclpy's does not."""
    refuse_or_set = node.set_parameters_atomically
    calibration = (
        '; set calibration to FILE for a whole calibration'
        if node.has_parameter('calibration')
        else ''
    )

    def set_parameters_atomically(given: list[Parameter]) -> msg.SetParametersResult:
        result = refuse_or_set(given)
        if _READ_ONLY in result.reason:
            result.reason += f' Start the node with it, or with --params-file FILE{calibration}.'
        return result

    # The services call it by the node.
    node.set_parameters_atomically = set_parameters_atomically  # type: ignore[assignment]
