"""Balanced state spaces near a measured response of many pairs, without starting values."""

from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Complex, Float


_DELAYS = (0.0, 0.25, 0.5, 1.0, 1.5, 2.0, 3.0, 4.5, 6.0)  # tried; rad at the highest frequency
_RELOCATIONS, _STILL, _DAMPING = 15, 1e-4, 0.3  # of poles; their last relative gain; at first
_FEW, _MANY, _REFINED = 15, 200, 3  # steps of a candidate, and of the best; candidates
_SETTLED = 1e-10  # relative gain of a step at which a descent ends
_CLEAR = 2.0  # standard errors, above which a delay is one

Matrix = Float[np.ndarray, "rows columns"]
Pairs = Complex[np.ndarray, "frequencies outputs inputs"]


class Samples(NamedTuple):
    """A response at frequencies, in which a model is rational: but for delays, G(s).

    s is j omega in rad/s; of inputs that are held for h seconds it is (exp(j omega h) - 1) / h, in
    which the sampled response is exactly rational, with all aliases.
    """

    s: Complex[np.ndarray, " frequencies"]
    omega: Float[np.ndarray, " frequencies"]  # rad/s
    response: Pairs
    weight: Float[np.ndarray, "frequencies outputs inputs"]  # 1 / error; 0: not used
    count: float  # real and imaginary parts, of independent points


class Realisation(NamedTuple):
    """G(s) = C (s - A)^-1 B, its inputs late by `delay` in seconds."""

    A: Matrix
    B: Matrix
    C: Matrix
    delay: Float[np.ndarray, " inputs"]

    def resolved(self, samples: Samples) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """C (s - A)^-1, (s - A)^-1 B late, and late = exp(-j omega delay), at each frequency."""
        resolvent = np.linalg.inv(samples.s[:, None, None] * np.eye(len(self.A)) - self.A)
        late = np.exp(-1j * samples.omega[:, None] * self.delay)
        return self.C @ resolvent, resolvent @ self.B * late[:, None], late

    def misfit(self, samples: Samples) -> Pairs:
        """What is left of the response, over its errors."""
        return samples.weight * (self.C @ self.resolved(samples)[1] - samples.response)

    def cost(self, samples: Samples) -> float:
        """Its sum of squares, real and imaginary parts over one standard error."""
        return float(np.sum(np.abs(self.misfit(samples)) ** 2))

    @property
    def numbers(self) -> Float[np.ndarray, " numbers"]:
        """A, B and C row by row, and the delays."""
        return np.concatenate([part.ravel() for part in self])

    def replaced(self, numbers: Float[np.ndarray, " numbers"]) -> "Realisation":
        """Others in the same shapes."""
        ends = np.cumsum([part.size for part in self])[:-1]
        parts = zip(np.split(numbers, ends), self, strict=True)
        return Realisation(*(new.reshape(old.shape) for new, old in parts))

    def sizes(self, samples: Samples) -> Float[np.ndarray, " numbers"]:
        """Typical sizes: of all of A, a row of B, a column of C, a radian at the last frequency."""
        A = np.full(self.A.shape, np.linalg.norm(self.A) / np.sqrt(len(self.A)))
        B = np.broadcast_to(_length(self.B, 1)[:, None], self.B.shape)
        C = np.broadcast_to(_length(self.C, 0), self.C.shape)
        return Realisation(A, B, C, np.full(self.delay.size, 1 / samples.omega[-1])).numbers

    def slopes(self, samples: Samples) -> Complex[np.ndarray, "numbers points"]:
        """Of the misfit by changes of a typical size."""
        (left, right, late), (outputs, inputs) = self.resolved(samples), samples.response.shape[1:]
        parts = [
            np.einsum("fok,fli->klfoi", left, right),
            np.einsum("fok,fi,ij->kjfoi", left, late, np.eye(inputs)),
            np.einsum("po,fli->plfoi", np.eye(outputs), right),
            np.einsum("f,foi,ij->jfoi", -1j * samples.omega, self.C @ right, np.eye(inputs)),
        ]
        rows = [(part * samples.weight).reshape(-1, samples.weight.size) for part in parts]
        return np.concatenate(rows) * self.sizes(samples)[:, None]

    def balanced(self, samples: Samples, order: int) -> tuple["Realisation", np.ndarray]:
        """The states that the response shows most, and the singular values of all.

        The Gramians are sums over the measured frequencies, over the errors, so that unstable
        plants have them too. Source: Gawronski and Juang, Int. J. Systems Sci. 21 (1990), p. 349.
        """
        left, right, _ = self.resolved(samples)
        by_input, by_output = (np.sqrt(np.mean(samples.weight**2, axis=k)) for k in (1, 2))
        reached = np.real(np.einsum("fki,fi,fli->kl", right, by_input, right.conj()))
        seen = np.real(np.einsum("fok,fo,fol->kl", left.conj(), by_output, left))
        reach, sight = (
            turn * np.sqrt(np.maximum(size, 0.0))
            for size, turn in map(np.linalg.eigh, (reached, seen))
        )
        u, size, v = np.linalg.svd(sight.T @ reach)
        scale = 1 / np.sqrt(np.maximum(size[:order], 1e-300))
        into, out = scale[:, None] * (u[:, :order].T @ sight.T), reach @ v[:order].T * scale
        return Realisation(into @ self.A @ out, into @ self.B, self.C @ out, self.delay), size


def _length(x: np.ndarray, axis: int) -> np.ndarray:
    return np.maximum(np.linalg.norm(x, axis=axis), 1e-150)


def fit_common_poles(samples: Samples, delay: float, order: int) -> Realisation:
    """Partial fractions with the same poles in all pairs, stable or not, of the least misfit.

    Source: Gustavsen and Semlyen, IEEE Trans. Power Delivery 14 (1999), p. 1052.
    """
    s, weight = samples.s, np.moveaxis(samples.weight, 0, -1)
    target = weight * np.moveaxis(
        samples.response * np.exp(1j * delay * samples.omega)[:, None, None], 0, -1
    )
    outputs, inputs, _ = target.shape
    parts = lambda x: np.concatenate([x.real, x.imag], axis=-2)
    size = np.geomspace(np.abs(s[0]), np.abs(s[-1]), order // 2 + 2)[1:-1]
    poles = np.append(
        size * (-_DAMPING + 1j), -np.exp(np.mean(np.log(np.abs(s))))[None][: order % 2]
    )
    goal, best, least = parts(target[..., None]), None, np.inf
    for _ in range(_RELOCATIONS):
        A, b, k = np.zeros((order, order)), np.zeros(order), 0
        for a, w in zip(np.real(poles), np.imag(poles), strict=True):  # the upper one of a pair
            width = 2 if w else 1
            A[k : k + width, k : k + width] = np.array([[a, w], [-w, a]])[:width, :width]
            b[k], k = width, k + width
        basis = np.linalg.solve(s[:, None, None] * np.eye(order) - A, b[:, None])[..., 0]
        columns = parts(weight[..., None] * basis)
        scale = _length(columns, -2)[..., None, :]
        q, r = np.linalg.qr(columns / scale)
        along = np.swapaxes(q, -1, -2)
        rest, before = goal - q @ (along @ goal), least
        cost = float(np.sum(rest**2))
        if cost < least:
            residues = (np.linalg.pinv(r) @ (along @ goal))[..., 0] / scale[..., 0, :]
            least, best = cost, (A, b, residues)
        if abs(before - cost) <= _STILL * cost:
            break
        shared = parts(-target[..., None] * basis)
        shared = (shared - q @ (along @ shared)).reshape(-1, order)
        norm = _length(shared, 0)
        numbers = np.linalg.lstsq(shared / norm, rest.reshape(-1), rcond=1e-13)[0] / norm
        roots = np.linalg.eigvals(A - np.outer(b, numbers))
        poles = roots[np.imag(roots) >= 0]
    assert best is not None, "the response is not finite"
    A, b, residues = best
    out = np.moveaxis(residues, -1, 1).reshape(outputs, order * inputs)
    A, B = (np.kron(part, np.eye(inputs)) for part in (A, b[:, None]))
    return Realisation(A, B, out, np.full(inputs, delay))


def descend(
    model: Realisation, samples: Samples, steps: int, late: Bool[np.ndarray, " inputs"]
) -> Realisation:
    """Levenberg-Marquardt on all numbers, with the delays of inputs that may be `late`, which stay
    positive. No step moves the states alone."""
    moving = np.append(np.ones(model.numbers.size - late.size), late)
    cost, damping = model.cost(samples), 1e-3
    for _ in range(steps):
        slopes, scale = model.slopes(samples) * moving[:, None], model.sizes(samples) * moving
        left = model.misfit(samples).reshape(-1)
        hessian, gradient = (slopes.conj() @ slopes.T).real, (slopes.conj() @ left).real
        size, before = np.diagonal(hessian), cost
        size = np.maximum(size, 1e-12 * np.max(size))
        while cost == before and damping < 1e8:
            change = scale * np.linalg.solve(hessian + damping * np.diag(size), gradient)
            trial = model.replaced(model.numbers - change)
            trial = trial._replace(delay=np.maximum(trial.delay, 0.0))
            reached = trial.cost(samples)
            better = reached < cost
            damping = max(damping / 10, 1e-10) if better else 4 * damping
            model, cost = (trial, reached) if better else (model, cost)
        if before - cost <= _SETTLED * before:
            break
    return model


def search(
    samples: Samples, order: int, delay: float | None
) -> tuple[Realisation, Float[np.ndarray, " states"]]:
    """The balanced state space of this order with the least misfit, and the singular values of
    partial fractions with two poles more. `delay` None: any of each input."""
    highest, late = samples.omega[-1], np.full(samples.response.shape[2], delay is None)
    starts = []
    for time in [delay] if delay is not None else [turn / highest for turn in _DELAYS]:
        for poles in (order, order + 2):
            start, size = fit_common_poles(samples, time, poles).balanced(samples, order)
            starts.append((np.nan_to_num(start.cost(samples), nan=np.inf), start, size))
    starts.sort(key=lambda start: start[0])
    few = [descend(start, samples, _FEW, late) for _, start, _ in starts[:_REFINED]]
    best = descend(min(few, key=lambda one: one.cost(samples)), samples, _MANY, late)
    if delay is None:
        slopes = best.slopes(samples)
        covariance = np.linalg.pinv(np.real(slopes.conj() @ slopes.T), 1e-12, hermitian=True)
        late = best.delay * highest > _CLEAR * np.sqrt(np.diagonal(covariance)[-late.size :])
        best = best._replace(delay=np.where(late, best.delay, 0.0))
        best = descend(best, samples, _MANY, late)
    return best.balanced(samples, order)[0], starts[0][2]
