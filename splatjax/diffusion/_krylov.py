"""Linear equations solved by GMRES, with one product in the program."""

from collections.abc import Callable

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

_MOST = 24  # products


def solve(
    product: Callable, right: Float[Array, "systems unknowns"], error: float
) -> Float[Array, "systems unknowns"]:
    """Solve independent systems of linear equations until every residual is at most `error` times
    the right side, root mean squares compared. Differentiable by the implicit function theorem.

    **Returns:** the unknowns; NaN in a system that 24 products do not solve.

    **Source:** Saad and Schultz 1986, "GMRES".
    """

    def gmres(product, right):
        return _gmres(product, right, error)

    return jax.lax.custom_linear_solve(product, right, gmres, gmres)


def _gmres(product, right, error):
    systems, unknowns = right.shape
    norm = jnp.sqrt(jnp.sum(right * right, axis=1))
    scale = jnp.where(norm > 0, norm, 1.0)
    basis = jnp.zeros((_MOST + 1, systems, unknowns), right.dtype).at[0].set(right / scale[:, None])
    hessenberg = jnp.zeros((systems, _MOST + 1, _MOST), right.dtype)
    start = jnp.zeros((systems, _MOST + 1), right.dtype).at[:, 0].set((norm > 0).astype(norm.dtype))

    def fit(hessenberg):
        # Columns that are still 0 get the coefficient 0.
        inverse = jnp.linalg.pinv(hessenberg)
        shares = jnp.einsum("skm,sm->sk", inverse, start)
        left = start - jnp.einsum("smk,sk->sm", hessenberg, shares)
        return shares, jnp.sqrt(jnp.sum(left * left, axis=1))

    def step(state):
        count, basis, hessenberg, _ = state
        new, column = product(basis[count]), 0
        for _ in range(2):  # again, for what rounding left
            along = jnp.einsum("msu,su->sm", basis, new)
            new, column = new - jnp.einsum("msu,sm->su", basis, along), column + along
        length = jnp.sqrt(jnp.sum(new * new, axis=1))
        basis = basis.at[count + 1].set(new / jnp.where(length > 0, length, 1.0)[:, None])
        hessenberg = hessenberg.at[:, :, count].set(column.at[:, count + 1].set(length))
        return count + 1, basis, hessenberg, jnp.max(fit(hessenberg)[1])

    def is_wanted(state):
        return (state[0] < _MOST) & (state[3] > error)

    begin = jnp.int32(0), basis, hessenberg, jnp.max(start)
    _, basis, hessenberg, _ = jax.lax.while_loop(is_wanted, step, begin)
    shares, left = fit(hessenberg)
    shares = jnp.where((left <= error)[:, None], shares, jnp.nan)
    return scale[:, None] * jnp.einsum("msu,sm->su", basis[:-1], shares)
