"""Counting the floating-point operations of a program's matrix products and convolutions, from its jaxpr.

Two for each product of two numbers that are added up. What is counted is the program that JAX has traced, before any
compiler: so it is one number on every device. XLA's own cost analysis is not used because it counts the body of a loop
once however often it runs, knows nothing of the library calls into which it turns products on a GPU, and adds up
operations of all kinds, of which a matrix multiplier does none.
"""

import math
from collections import Counter
from typing import Any

from jax.extend.core import ClosedJaxpr, Jaxpr
from jax.interpreters.partial_eval import dce_jaxpr


def count_flops(program: ClosedJaxpr) -> int:
    """Operations of a traced program (`jax.jit(f).trace(...).jaxpr`), less what no output needs.

    Of a branch the dearer side counts. Raises ValueError for a product in a loop whose turns depend on values.
    """
    return flops_by_name(program).total()


def flops_by_name(program: ClosedJaxpr) -> Counter[str]:
    """The same, by the path of names under which the operations were traced (transforms, modules, the operation)."""
    needed, _ = dce_jaxpr(program.jaxpr, [True] * len(program.jaxpr.outvars))
    return _count(needed, "")


def _count(program: Jaxpr, outside: str) -> Counter[str]:
    counted: Counter[str] = Counter()
    for equation in program.eqns:
        counted += _of_equation(equation, outside)
    return counted


def _of_equation(equation: Any, outside: str) -> Counter[str]:
    name = equation.primitive.name
    path = "/".join(filter(None, (outside, str(equation.source_info.name_stack))))
    if name == "dot_general":
        return Counter({f"{path}/{name}": _of_product(equation)})
    if name == "conv_general_dilated":
        return Counter({f"{path}/{name}": _of_convolution(equation)})
    inner = [_count(each, path) for each in _inner_programs(equation.params)]
    if name == "cond":
        return max(inner, key=Counter.total)
    if name == "while" and any(inner):
        raise ValueError("a matrix product in a loop whose number of turns is not known cannot be counted")
    turns = equation.params["length"] if name == "scan" else 1
    return Counter({path: turns * flops for path, flops in sum(inner, Counter()).items()})


def _of_product(equation: Any) -> int:
    (summed, _), _ = equation.params["dimension_numbers"]
    left, out = equation.invars[0].aval.shape, equation.outvars[0].aval.shape
    return 2 * math.prod(out) * math.prod(left[axis] for axis in summed)


def _of_convolution(equation: Any) -> int:
    """Every output adds up a kernel's worth of products; zeros between the inputs (`lhs_dilation`) are no work.

    Such zeros are in the gradient of a convolution with strides. Padding counts, as it does everywhere.
    """
    _, _, *spatial = equation.params["dimension_numbers"].rhs_spec
    kernel, out = equation.invars[1].aval.shape, equation.outvars[0].aval.shape
    inputs = kernel[equation.params["dimension_numbers"].rhs_spec[1]]
    taps = math.prod(kernel[axis] for axis in spatial)
    return 2 * math.prod(out) * inputs * taps // math.prod(equation.params["lhs_dilation"])


def _inner_programs(params: dict[str, Any]) -> list[Jaxpr]:
    values = [each for value in params.values() for each in (value if isinstance(value, tuple) else (value,))]
    opened = [each.jaxpr if isinstance(each, ClosedJaxpr) else each for each in values]
    return [each for each in opened if isinstance(each, Jaxpr)]
