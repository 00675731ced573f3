# SPDX-License-Identifier: Apache-2.0

"""Arrays of a simulator, of any library and device, as those of numpy and back."""

from __future__ import annotations

from typing import Any

from adxl_ros.errors import install_hint, UserError
import numpy as np


def of_each(name: str, values: float | np.ndarray, count: int) -> np.ndarray:
    """Return a number, or a number for each sensor, as (1, n)."""
    numbers = np.asarray(on_host(values), float)
    if numbers.shape not in ((), (count,)):
        raise UserError(f'{name} has the shape {numbers.shape}; expected a number or ({count},)')
    if not np.isfinite(numbers).all():
        raise UserError(f'{name} is not finite; check the simulation')
    return np.broadcast_to(numbers, (1, count))


def on_host(array: Any) -> np.ndarray:
    """Return an array of any library and device as one of numpy."""
    return np.asarray(array.detach().cpu() if hasattr(array, 'detach') else array)


def like(values: np.ndarray, like: Any) -> Any:
    """Return values as an array of the same library, floating type and device as another one."""
    if isinstance(like, np.ndarray):
        return values.astype(like.dtype) if np.issubdtype(like.dtype, np.floating) else values
    if isinstance(like, list | tuple):
        return values
    try:
        from array_api_compat import array_namespace, device
    except ImportError:
        raise UserError(
            'arrays of other libraries than numpy need array-api-compat; '
            f'{install_hint("array-api-compat")}'
        ) from None
    space = array_namespace(like)
    is_floating = space.isdtype(like.dtype, 'real floating')
    return space.asarray(
        values, dtype=like.dtype if is_floating else space.float32, device=device(like)
    )


def chosen(env_ids: Any, count: int) -> np.ndarray:
    """Return the numbers of some of n sensors: numbers, a mask, a slice, or None for all."""
    if env_ids is None:
        return np.arange(count)
    is_plain = isinstance(env_ids, slice | list)
    return np.arange(count)[env_ids if is_plain else on_host(env_ids)]
