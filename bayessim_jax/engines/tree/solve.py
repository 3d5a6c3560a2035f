"""Linear systems with the mass matrix of a tree."""

from __future__ import annotations

from collections.abc import Sequence

from bayessim_jax.engines.tree.folding import Folded

__all__ = ["add_to_diagonal", "solve"]


def solve(matrix: Sequence[Sequence[Folded]], right: Sequence[Folded]) -> list[Folded]:
    """Solve M x = b, by M = Lᵀ D L from the leaves to the root, which leaves zeros between branches zero.

    Source: Featherstone 2008, ch. 6
    """
    m, x = [list(row) for row in matrix], list(right)
    size = len(x)
    inverse = x[:]
    for k in reversed(range(size)):
        inverse[k] = 1.0 / m[k][k]
        for i in reversed(range(k)):
            if m[k][i].equals(0.0):
                continue
            factor = m[k][i] * inverse[k]
            for j in range(i + 1):
                m[i][j] = m[i][j] - factor * m[k][j]
            m[k][i] = factor
            x[i] = x[i] - factor * x[k]
    for k in range(size):
        x[k] = x[k] * inverse[k]
        for i in range(k):
            x[k] = x[k] - m[k][i] * x[i]
    return x


def add_to_diagonal(matrix: Sequence[Sequence[Folded]], values: Sequence[Folded]) -> list[list[Folded]]:
    """M + diag(values)."""
    return [[entry + values[i] if i == j else entry for j, entry in enumerate(row)] for i, row in enumerate(matrix)]
