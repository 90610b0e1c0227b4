"""Adam with a full-matrix second moment per keyframe and a multilevel preconditioner over neighbouring keyframes."""

from __future__ import annotations

import warnings
from functools import lru_cache
from math import sqrt
from typing import TYPE_CHECKING, Any

import numpy as np
import torch

if TYPE_CHECKING:
    from collections.abc import Callable

    from jaxtyping import Float
    from scipy.sparse import csr_matrix
    from torch import Tensor

_ROOTS_A_STEP = 256
_FEW = 4
"""Number of rows or stretches at which coarsening stops."""


class KeyframeAdam(torch.optim.Optimizer):
    """Adam with a matrix-valued second moment for each parameter row and for each stretch of rows.

    A small rotation resembles a translation: events constrain their sum well and their difference poorly. Adam scales
    each parameter separately, so the noise of the sum also limits the difference. Here, the mean gradient of a row is
    multiplied by C^(-1/2), where C is the exponential moving average of its gradients' outer products (full-matrix
    AdaGrad, Duchi et al. 2011, with Adam's decay): each direction is scaled by its own noise.

    Drift bends whole stretches of a trajectory, which shows in the sum of the keyframe gradients but not in a single
    one. So rows move by the sum of such steps over all stretch widths, 1, 2, 4, ... rows to either side (the multilevel
    preconditioner of Bramble, Pasciak & Xu 1990): P C_P^(-1/2) P^T times the mean gradient, where each row of P^T is
    the hat function of one stretch. Without ``stretches``, and for rows of one parameter, this is Adam.

    ``eps`` is added to each eigenvalue as a share of the matrix's mean diagonal. Inverse roots of matrices of mean
    diagonal 1 are recomputed for at most 256 rows and stretches per step, in turn; rows do not move before their first
    one. The mean diagonal itself is always current, and no step is longer than it could be with a current root: while
    the field is young, gradients grow tenfold in a few steps. Without ``coupled``, each parameter is scaled separately.
    A ``power`` below 1/2, C^(-power), moves poorly constrained directions less.
    """

    def __init__(
        self,
        params: Any,
        lr: float = 0.03,
        betas: tuple[float, float] = (0.9, 0.99),
        eps: float = 1e-3,
        coupled: bool = True,
        stretches: bool = True,
        power: float = 0.5,
    ):
        super().__init__(params, {"lr": lr, "betas": betas, "eps": eps})
        self.coupled, self.stretches, self.power = coupled, stretches, power

    @torch.no_grad()
    def step(self, closure: Callable[[], Any] | None = None) -> None:  # pyright: ignore[reportIncompatibleMethodOverride]
        """Move every row and stretch by about the learning rate in each direction with a consistent gradient sign."""
        assert closure is None
        for group in self.param_groups:
            for rows in group["params"]:
                if rows.grad is not None:
                    rows.sub_(group["lr"] * self._direction(rows, rows.grad, group["betas"], group["eps"]))

    def _direction(
        self, rows: Tensor, gradient: Float[Tensor, "rows dim"], betas: tuple[float, float], eps: float
    ) -> Float[Tensor, "rows dim"]:
        state, (beta1, beta2) = self.state[rows], betas
        onto_stretches, onto_rows = _stretches(len(rows), rows.device, rows.dtype) if self.stretches else (None, None)
        gradient = gradient if onto_stretches is None else onto_stretches @ gradient
        count, dim = gradient.shape
        if not state:
            state["step"] = 0
            state["mean"] = torch.zeros_like(gradient)
            state["outer"] = gradient.new_zeros(count, dim, dim)
        # Checkpoints of earlier versions have roots that include the scale.
        if "unit_root" not in state:
            state["unit_root"] = gradient.new_zeros(count, dim, dim)
        step, outer, root = state["step"], state["outer"], state["unit_root"]
        state["mean"].lerp_(gradient, 1 - beta1)
        outer.lerp_(gradient[:, :, None] * gradient[:, None, :], 1 - beta2)
        due = (step * _ROOTS_A_STEP + torch.arange(min(count, _ROOTS_A_STEP), device=rows.device)) % count
        size = outer.diagonal(dim1=-2, dim2=-1).mean(dim=-1)
        known = size > 0
        size = torch.where(known, size, torch.ones_like(size))
        seen = outer[due] if self.coupled else outer[due] * torch.eye(dim).to(outer)
        root[due] = _inverse_power(seen / size[due, None, None], eps, self.power)
        state["step"] = step + 1
        mean = state["mean"] / (1 - beta1 ** (step + 1)) * (size / (1 - beta2 ** (step + 1))).rsqrt()[:, None]
        direction = known[:, None] * (root @ mean[..., None])[..., 0]
        longest = _longest(beta1, beta2) * dim ** ((0.5 if self.coupled else 1.0) - self.power)
        direction = direction / (direction.norm(dim=-1, keepdim=True) / longest).clamp_min(1)
        return direction if onto_rows is None else onto_rows @ direction


@lru_cache(maxsize=4)
def _stretches(
    count: int, device: torch.device, dtype: torch.dtype
) -> tuple[Float[Tensor, "stretches rows"], Float[Tensor, "rows stretches"]]:
    """Sparse matrices from rows to stretches around every row, every second, fourth, ... row, down to a few, and back.

    A stretch is a hat function: a row between two stretches contributes half to each; a row after the last contributes
    fully to it. The transpose is stored too, because products with a transposed view are many times slower.
    """
    # Imported here because only stretches need it.
    from scipy.sparse import csr_matrix, identity, vstack

    level, levels = identity(count, format="csr"), []
    while True:
        levels.append(level)
        if count <= _FEW:
            break
        finer, count = np.arange(count), (count + 1) // 2
        halves = np.r_[finer // 2, np.minimum((finer + 1) // 2, count - 1)]
        level = csr_matrix((np.full(len(halves), 0.5), (halves, np.tile(finer, 2)))) @ level
    stacked = csr_matrix(vstack(levels))
    return _as_tensor(stacked, device, dtype), _as_tensor(csr_matrix(stacked.T), device, dtype)


def _as_tensor(sparse: csr_matrix, device: torch.device, dtype: torch.dtype) -> Tensor:
    sparse.sort_indices()
    parts = (torch.from_numpy(part) for part in (sparse.indptr, sparse.indices, sparse.data))
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", "Sparse CSR tensor support is in beta", UserWarning)
        return torch.sparse_csr_tensor(*parts, size=sparse.shape, dtype=dtype, device=device, check_invariants=True)


def _longest(beta1: float, beta2: float) -> float:
    """Upper bound of |C^(-1/2) m| for the moving averages m of gradients and C of their outer products.

    By Cauchy and Schwarz, m' C⁻¹ m is at most the sum of squared weights in m over those in C.
    """
    ratio = beta1**2 / beta2
    return (1 - beta1) / sqrt((1 - beta2) * (1 - ratio)) if ratio < 1 else 1e30


def _inverse_power(outer: Float[Tensor, "rows dim dim"], eps: float, power: float) -> Float[Tensor, "rows dim dim"]:
    """(C + eps)^-power for matrices C of mean diagonal 1, or 0."""
    spread, direction = torch.linalg.eigh(outer)
    return direction @ ((spread.clamp_min(0) + eps).pow(-power)[..., None] * direction.mT)
