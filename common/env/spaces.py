"""Which spaces the agent can learn in, and their values as vectors: Dicts, Tuples and boxes of any shape.

Shapes: O numbers of an observation, A of an action, in the order in which gymnasium flattens a space.
"""

import math
import reprlib
from typing import Any

import gymnasium as gym
import numpy as np
from numpy.typing import NDArray

from rmc.common.env.faults import PASSED_ON
from rmc.common.env.layout import Part
from rmc.common.errors import EnvFault

LARGEST_ACTION = 1e9  # of an action space that means its bounds
IMAGE_SIDE = 32  # pixels: what has two sides as long is taken for an image
NUMBERS = "biuf"  # numpy's kinds of numbers
LISTED = 10  # places that a fault names


def space_fault(observation: gym.Space[Any], action: gym.Space[Any]) -> str | None:
    """Why the agent cannot learn with these spaces, and what to do about it; None if it can."""
    return (
        _kind_fault("observations", observation)
        or _image_fault(observation)
        or _kind_fault("actions", action)
        or _action_fault(action)
    )


def bounds(action: gym.Space[Any]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """(A,) lowest and (A,) highest values."""
    boxes = [box for _, box in _leaves(action)]
    low, high = (np.concatenate([np.ravel(getattr(box, side)) for box in boxes]) for side in ("low", "high"))
    return low.astype(np.float64), high.astype(np.float64)


def parts(space: gym.Space[Any]) -> tuple[Part, ...]:
    """The boxes that a space is made of, in order."""
    boxes: list[Part] = []
    for name, box in _leaves(space):
        start, shape = boxes[-1].stop if boxes else 0, box.shape or ()
        boxes.append(Part(name, start, start + math.prod(shape), shape, np.dtype(box.dtype).name))
    return tuple(boxes)


def vector(space: gym.Space[Any], value: Any) -> NDArray[np.float32]:
    """An observation as (O,), a copy. Raises EnvFault where it is not of the numbers and shapes that its space says."""
    if isinstance(space, gym.spaces.Box):
        return _numbers(space, value)
    return np.concatenate([vector(part, _part(value, name)) for name, part in _parts(space)])


def _numbers(box: gym.Space[Any], value: Any) -> NDArray[np.float32]:
    if isinstance(value, np.ma.MaskedArray) and np.ma.is_masked(value):  # the mask would be lost
        fix = 'return zeros where it masks, and say so in info["missing"]'
        raise EnvFault(f"the environment's observation is a masked array; {fix}")
    numbers = array("observation", value, "an array of numbers")
    if numbers.shape != box.shape and _sides(numbers.shape) != _sides(box.shape or ()):
        raise EnvFault(f"the environment's observation has shape {numbers.shape}, its space says {box.shape}")
    with np.errstate(over="ignore", under="ignore"):  # what is too large becomes infinite, and is judged with the rest
        return np.array(numbers, np.float32).ravel()  # a copy: some environments write into the same one again


def array(name: str, value: Any, expected: str) -> NDArray[Any]:
    """What is of numbers as an array; no copy. Raises EnvFault with what is ``expected`` where it is none."""
    try:
        numbers = np.asarray(value)
    except PASSED_ON:
        raise
    except BaseException:  # a list whose rows differ, or a tensor on another device
        numbers = np.empty(0, object)
    if numbers.dtype.kind not in NUMBERS:
        raise EnvFault(f"the environment's {name} is {reprlib.repr(value)}; return {expected}")
    return numbers


def check_finite(name: str, numbers: NDArray[np.float32]) -> None:
    """Raises EnvFault with the places of (N,) that are not."""
    if not np.isfinite(numbers).all():
        places = np.flatnonzero(~np.isfinite(numbers)).tolist()
        where = f"{places[:LISTED]}{' and more' * (len(places) > LISTED)}"
        raise EnvFault(f"the environment's {name} is not finite at {where}; return finite numbers that float32 holds")


def _sides(shape: tuple[int, ...]) -> list[int]:
    """Those that order numbers: a column, a row and a plain vector hold the same."""
    return [side for side in shape if side != 1]


def _part(value: Any, name: Any) -> Any:
    try:
        return value[name]
    except (KeyError, IndexError, TypeError):
        raise EnvFault(f"the environment's observation has no part {name!r}, which its space names") from None


def _parts(space: gym.Space[Any]) -> list[tuple[Any, gym.Space[Any]]]:
    """What a Dict or a Tuple is made of; nothing of others."""
    if isinstance(space, gym.spaces.Dict):
        return list(space.spaces.items())
    return list(enumerate(space.spaces)) if isinstance(space, gym.spaces.Tuple) else []


def _leaves(space: gym.Space[Any], path: str = "") -> list[tuple[str, gym.Space[Any]]]:
    """What is left when every Dict and Tuple is taken apart, by dotted path; also those in another that are empty."""
    if not isinstance(space, gym.spaces.Dict | gym.spaces.Tuple) or (path and not _parts(space)):
        return [(path, space)]
    return [leaf for name, part in _parts(space) for leaf in _leaves(part, f"{path}.{name}".lstrip("."))]


def _kind_fault(what: str, space: gym.Space[Any]) -> str | None:
    leaves = _leaves(space)
    odd = {path: _kind(leaf) for path, leaf in leaves if not isinstance(leaf, gym.spaces.Box)}
    if "" in odd:
        return f"its {what} are {odd['']}; RMC takes a Box of numbers, or a Dict or Tuple of such boxes"
    if odd:
        return f"of its {what} {odd} are no Box; turn them into one, or leave them out"
    if not sum(math.prod(leaf.shape or ()) for _, leaf in leaves):
        return f"its {what} have shape {space.shape}: there are none; give at least one number"
    return None


def _kind(space: Any) -> str:
    """Its class's name; of a Box that is not gymnasium's, with the module that it is of."""
    kind = type(space)
    return f"{kind.__module__}.{kind.__name__}" if kind.__name__ == "Box" else kind.__name__


def _image_fault(observation: gym.Space[Any]) -> str | None:
    images = {path: leaf.shape for path, leaf in _leaves(observation) if _is_image(leaf)}
    if not images:
        return None
    reason = f"its observations are images {images['']}" if "" in images else f"of its observations {images} are images"
    fix = "give what an encoder or the simulator tells of them; what is no image, give in one dimension"
    return f"{reason}; only vectors are learnt from: {fix}"


def _is_image(box: gym.Space[Any]) -> bool:
    sides = sorted(_sides(box.shape or ()))
    return len(sides) > 1 and (box.dtype == np.uint8 or sides[-2] >= IMAGE_SIDE)


def _action_fault(action: gym.Space[Any]) -> str | None:
    whole = [str(leaf.dtype) for _, leaf in _leaves(action) if not np.issubdtype(leaf.dtype, np.floating)]
    if whole:
        return f"its actions are {whole[0]}; only continuous ones (a Box of floats) are learnt"
    low, high = bounds(action)
    largest = np.abs([low, high]).max()
    if not largest < LARGEST_ACTION:
        reach = f"reaches {largest:g}" if largest < np.inf else "is unbounded"
        return f"its action space {reach}; give it a Box with the low and high that its actions really have"
    fixed = np.flatnonzero(low >= high).tolist()
    if fixed:
        return (
            f"its actions {fixed} cannot move: low is high, {low[fixed].tolist()}; leave them out of the action space"
        )
    return None
