"""Records that convert numbers, lists, tuples and NumPy arrays to JAX arrays.

    @record
    class Medium(eqx.Module):
        sigma_a: Float[Array, " channels"] = eqx.field(converter=numbers)
        sigma_s_prime: Float[Array, " channels"] = eqx.field(converter=numbers)
        eta: Float[Array, " channels"] = eqx.field(
            converter=numbers, metadata=valid("positive", lambda x: x > 0)
        )

`Medium([0.02, 0.01], [1.1, 1.3], eta=1.4)` has three arrays of two channels. The annotation of a
field states its axes; its converter states, for type checkers too, the types that it accepts.
`record` converts all fields together, because the length and the precision of one depend on the
others. The metadata of a field (`valid`) state its range; conditions on several fields are checked
in `__check_init__`.
"""

import dataclasses
import importlib.util
import inspect
from collections.abc import Callable, Sequence
from types import NoneType, UnionType
from typing import Any, TypeAlias, TypeVar, get_args, get_origin

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer
from jax.typing import ArrayLike
from jaxtyping import Array, DTypeLike

Class = TypeVar("Class", bound=type)
Item = TypeVar("Item")
# Everything that can be converted to an array.
Numbers: TypeAlias = ArrayLike | Sequence[Any] | jax.ShapeDtypeStruct


def numbers(values: Numbers | None) -> Any:
    """Mark a field, as its converter, as one that accepts `Numbers`."""
    return values


def several(values: Item | Sequence[Item]) -> Any:
    """Mark a field, as its converter, as one that accepts a record or several records."""
    return values


def plain_int(value: Any) -> Any:
    """Convert NumPy's integers, for static fields."""
    return int(value) if isinstance(value, np.integer) else value


def valid(
    requirement: str, holds: Callable[[np.ndarray], Any] = lambda x: x == x, finite: bool = True
) -> dict[str, Any]:
    """Make field metadata that state the valid values, as arguments of `check_values`."""
    return {"valid": (requirement, holds, finite)}


def record(cls: Class) -> Class:
    r"""Convert the arguments of a class of records before its `__init__` sees them.

    - Fields of `numbers` become strongly typed arrays of floats. Their precision is that of the
      first floating-point array among the fields (records first), or JAX's default. A number is
      repeated along axes whose lengths are known from other fields, or from the `channels` of a
      record. An array without the last axis `channels` gets one channel.
    - Fields of `several` records become tuples.
    - Fields of records must be records of the annotated class.
    - Values must be `valid`. Fields whose metadata state `linear` (light) refuse integer arrays.

    Traced values are converted too. `None` and objects that are not numbers, such as JAX's
    placeholders, pass unchanged. Records that JAX unflattens are not converted again.

    **Raises:** `ValueError`, when a record is made, with the field, its shape or class, and the
    remedy.
    """
    initialize, signature = cls.__init__, inspect.signature(cls)
    axes, classes, declared = {}, {}, dataclasses.fields(cls)  # ty: ignore[invalid-argument-type]
    ranges = {item.name: item.metadata["valid"] for item in declared if "valid" in item.metadata}
    linear = [item.name for item in declared if "linear" in item.metadata]
    for field in declared:
        is_tuple = get_origin(field.type) is tuple
        annotation = get_args(field.type)[0] if is_tuple else field.type
        kinds = get_args(annotation) if isinstance(annotation, UnionType) else (annotation,)
        if field.metadata.get("converter") is numbers:
            axes[field.name] = kinds[0].dim_str.split()  # ty: ignore[missing-union-attribute]
        elif all(inspect.isclass(kind) and issubclass(kind, _RECORDS) for kind in kinds):
            classes[field.name] = kinds, is_tuple

    def __init__(self, *args, **kwargs):
        try:
            bound = signature.bind(*args, **kwargs)
        except TypeError as error:
            raise TypeError(f"{error}; give {_call(cls)}") from None
        bound.apply_defaults()
        values, records = bound.arguments, []
        for name in linear:
            if jnp.issubdtype(getattr(values[name], "dtype", float), jnp.integer):
                raise ValueError(
                    f"{cls.__name__}.{name} has integer dtype {values[name].dtype}, as encoded "
                    "for a display; give linear light in floating-point numbers"
                )
        for name, (kinds, is_tuple) in classes.items():
            is_many = isinstance(values[name], list | tuple)
            parts = tuple(values[name]) if is_tuple and is_many else (values[name],)
            for part in parts:
                if not _is_placeholder(part):
                    check_class(f"{cls.__name__}.{name}", part, *kinds)
            values[name] = parts if is_tuple else parts[0]
            records += parts
        initialize(self, **(values | _converted(cls.__name__, axes, values, records)))
        for name, requirement in ranges.items():
            check_values(f"{cls.__name__}.{name}", getattr(self, name), *requirement)

    # Without annotations, because runtime type checkers would refuse arguments before conversion.
    receiver = inspect.Parameter("self", inspect.Parameter.POSITIONAL_OR_KEYWORD)
    fields = [part.replace(annotation=part.empty) for part in signature.parameters.values()]
    __init__.__signature__ = inspect.Signature([receiver, *fields])  # ty: ignore[missing-attribute]
    cls.__init__ = __init__  # ty: ignore[invalid-assignment]
    cls.__repr__ = _with_numbers  # ty: ignore[invalid-assignment]
    return cls


def _with_numbers(self: eqx.Module) -> str:
    """Show the numbers of a small record, and the shapes of a large one."""
    leaves = [leaf for leaf in jax.tree.leaves(self) if eqx.is_array(leaf)]
    is_small = sum(leaf.size for leaf in leaves) <= _MOST_SHOWN and not is_traced(leaves)
    return eqx.tree_pformat(self, short_arrays=not is_small)


def require(holds: Any, message: str) -> None:
    """Raise `ValueError(message)` unless a condition holds."""
    if not holds:
        raise ValueError(message)


def check_class(name: str, value: Any, *kinds: type) -> None:
    """Raise `ValueError` unless a value is an instance of one of the classes."""
    if not isinstance(value, kinds):
        raise ValueError(
            f"{name} must be {' or '.join(map(_call, kinds))}; got {type(value).__name__}"
        )


def check_installed(use: str, module: str, package: str | None = None) -> None:
    """Raise `ValueError` if an optional package is missing; the message names what needs it."""
    package = package or module
    require(
        importlib.util.find_spec(module) is not None,
        f"{use} needs {package}; install it: pip install {package}",
    )


def _call(cls: type) -> str:
    """Format a call of a class with its parameters; an abstract class has none."""
    parameters = ", ".join(inspect.signature(cls).parameters)
    return f"{cls.__name__}({parameters})" if parameters else cls.__name__


def as_floats(values: Numbers, dtype: DTypeLike | None = None, name: str = "values") -> Array:
    """Convert numbers to a strongly typed array of floats, by default in their own precision."""
    dtype = dtype or precision_of(values)
    if isinstance(values, jax.Array) and values.dtype == dtype and not values.weak_type:
        return values
    try:
        return jnp.asarray(values, dtype)
    except (TypeError, ValueError):
        raise ValueError(
            f"{name} must be numbers, in rows of equal length; got {values!r}"
            f"{'; see sj.scene.studio() and sj.io.load_environment' if '.image' in name else ''}"
        ) from None


def is_traced(tree: Any) -> bool:
    """Return whether a tree contains a traced array."""
    return any(isinstance(leaf, Tracer) for leaf in jax.tree.leaves(tree))


def check_values(
    name: str,
    values: Any,
    requirement: str,
    holds: Callable[[np.ndarray], Any],
    finite: bool = True,
) -> None:
    r"""Check a number, or every entry of an array. Traced values are not checked.

    **Arguments:**

    - `name`: name of the values in the error.
    - `values`: a number or an array; other objects pass.
    - `requirement`: completes "must be", with the remedy.
    - `holds`: computes elementwise whether entries meet the requirement. The valid numbers must
      form an interval.
    - `finite`: whether infinite entries are refused; NaN always is.

    **Raises:** `ValueError` with the number, or with the count of invalid entries and the first of
    them.
    """
    kinds = jax.Array | np.ndarray | np.number | int | float
    is_known = isinstance(values, kinds) and not is_traced(values)
    if not is_known or not np.size(values) or not getattr(values, "is_fully_addressable", True):
        return

    def is_good(entries):
        return holds(entries) & (np.isfinite(entries) if finite else ~np.isnan(entries))

    array = np.asarray(values)
    if not np.all(is_good(np.stack([array.min(), array.max()]))):
        good = is_good(array)
        place = tuple(np.argwhere(~good)[0].tolist())
        fault = f"{np.sum(~good)} of {array.size} entries are not; the first is" if place else "got"
        raise ValueError(
            f"{name} must be {requirement}; {fault} {array[place]:g}"
            f"{f' at {list(place)}' if place else ''}"
        )


def check_ascending(name: str, values: Any) -> None:
    steps, requirement = np.diff(values), f"positive: {name} ascend; sort them"
    check_values(f"the steps of {name}", steps, requirement, lambda x: x > 0)


_MOST_SHOWN = 60  # numbers
_RECORDS = (eqx.Module, NoneType)


def _is_placeholder(value: Any) -> bool:
    """Return whether a value is `None` or a placeholder of JAX for an array or a record."""
    convertible = bool | int | float | complex | str | list | tuple | eqx.Module
    return not isinstance(value, convertible) and not hasattr(value, "__array__")


def _converted(
    record: str, axes: dict[str, list[str]], values: dict[str, Any], records: list
) -> dict[str, Array]:
    """Convert the values of all fields of `numbers`."""
    inputs = {name: values[name] for name in axes if not _is_placeholder(values[name])}
    precision = precision_of([records, list(inputs.values())])
    arrays = {
        name: as_floats(value, precision, f"{record}.{name}") for name, value in inputs.items()
    }
    channels = [part.channels for part in records if hasattr(part, "channels")]
    lengths = {"channels": channels[0]} if channels else {}
    # Numbers come last, when the lengths of axes are known.
    return {
        name: _shaped(f"{record}.{name}", array, axes[name], lengths)
        for name, array in sorted(arrays.items(), key=lambda item: item[1].ndim == 0)
    }


def _shaped(where: str, array: Array, axes: list[str], lengths: dict[str, int]) -> Array:
    """Add the axes that a number or a single channel lacks, and record the lengths of all axes."""
    if any(axis.startswith("*") for axis in axes):
        return array
    if array.ndim == 0 and axes and all(axis in lengths for axis in axes):
        return jnp.broadcast_to(array, [lengths[axis] for axis in axes])
    if array.ndim == len(axes) - 1 and axes[-1].lstrip("#") == "channels":
        array = array[..., None]
    required = [int(axis) if axis.isdigit() else lengths.get(axis, axis) for axis in axes]
    # A string is an axis of unknown length.
    matches = [
        actual == length or isinstance(length, str)
        for actual, length in zip(array.shape, required, strict=False)
    ]
    if array.ndim != len(axes) or not all(matches):
        raise ValueError(
            f"{where} has shape {list(array.shape)}; give it [{', '.join(axes)}] = "
            f"[{', '.join(map(str, required))}], like the other fields"
            f"{' (make batches by jax.vmap)' if array.ndim > len(axes) else ''}"
        )
    lengths |= dict(zip(axes, array.shape, strict=True))
    return array


def precision_of(tree: Any) -> Any:
    """Return the dtype of the first floating-point array, at least float32, or JAX's default."""
    for leaf in jax.tree.leaves(tree):
        is_strong = isinstance(leaf, jax.Array | np.ndarray) and not getattr(
            leaf, "weak_type", False
        )
        if is_strong and jnp.issubdtype(leaf.dtype, jnp.floating):
            return jax.dtypes.canonicalize_dtype(max(leaf.dtype, np.dtype(np.float32)))
    return jnp.result_type(float)
