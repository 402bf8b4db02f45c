"""Proved damping: a lower bound of the closed-loop damping over every plant of an identified set."""

from __future__ import annotations

import hashlib
from collections.abc import Mapping
from dataclasses import dataclass, replace
from enum import StrEnum
from itertools import product
from math import comb, nan
from time import monotonic
from typing import Annotated, Any

import casadi as ca
import numpy as np
import scipy
from annotated_types import Ge, Gt, Lt

from gbid.control.controllers.file import ControllerDesign
from gbid.control.controllers.structures import Scheduled, controller_model
from gbid.control.tuning.loops import PADE_ORDER
from gbid.control.tuning.plants import root_of
from gbid.control.tuning.result import GainResult
from gbid.core.arrays import ComplexArray, FloatArray
from gbid.core.brief import Brief, Description, brief
from gbid.core.errors import UsageError
from gbid.core.option_types import Finite, Positive
from gbid.lpv import LPVFit
from gbid.structure import LinearModel, PiezoPair, RotorBearing
from gbid.structure.delay import unit_ladder
from gbid.structure.linear import evaluate, symbolic_matrices

ROUNDING = 1e-11
"""Relative allowance for rounding in every bound; the longest sum has some hundred terms of double precision."""
_SKEW = 1.5
"""Condition of eigenvectors, for each state, from which singular vectors take their place: near a double eigenvalue."""
_HALF_PLANES = np.exp(1j * np.linspace(-1.2, 1.2, 13))
_CUT_LESS = 0.6
"""Weight of cuts of the ellipsoid among the axes of a split; a study of four designs gave the fewest cells."""


@dataclass(frozen=True, eq=False)
class PlantSet:
    r"""Every loop of a set of plants as one matrix function, singular exactly at the poles of a loop.

    .. math:: F(\lambda) = \lambda I - M(\theta)\, [I;\ \delta(\lambda \tau(\theta)) H(\lambda)]

    M and tau are affine in the parameters theta, which are polynomials in the scheduling variables. Their coefficients
    fill an ellipsoid. H is the known part: controller and actuators, from the plant's states to its inputs.

    Attributes
    ----------
    M : (1 + k, n, n + m) array
        State and input matrices side by side: the constant part, and the slope by each parameter.
    tau : (1 + k, m) array
        Delay of each input [s], likewise.
    H : tuple of arrays
        A, B, C, D of the known part.
    pade : (order,) array
        Poles of the Padé approximation of a delay of one; empty without delays.
    coefficients : (k, t) array
        Coefficients of the polynomials, and the centre of the ellipsoid.
    covariance : (k, t, k, t) array
        Shape of the ellipsoid.
    radius : float
        Its radius in standard deviations.
    directions : (q, k, t) array
        Conjugate semi-axes of the ellipsoid (one standard deviation), along which cells are cut.
    exponents : (t, v) array
        Powers of the scheduling variables in each term.
    box : (v, 2) array
        Range of each scheduling variable.
    """

    M: FloatArray
    tau: FloatArray
    H: tuple[FloatArray, FloatArray, FloatArray, FloatArray]
    pade: ComplexArray
    coefficients: FloatArray
    covariance: FloatArray
    radius: float
    directions: FloatArray
    exponents: FloatArray
    box: FloatArray


def local_terms(exponents: FloatArray, centre: FloatArray, half: FloatArray) -> FloatArray:
    """Coefficients (N, t, e) of the terms at ``centre + half s`` as polynomials in s: 1, each s, others."""
    v = exponents.shape[1]
    first = [tuple(row) for row in np.vstack([np.zeros((1, v), int), np.eye(v, dtype=int)])]
    every = {power for row in exponents for power in product(*(range(e + 1) for e in row))}
    powers = first + sorted(every - set(first))
    T = np.zeros((len(centre), len(exponents), len(powers)))
    for j, row in enumerate(exponents):
        for e, power in enumerate(powers):
            if all(p <= q for p, q in zip(power, row, strict=True)):
                factor = np.prod([comb(q, p) for p, q in zip(power, row, strict=True)])
                T[:, j, e] = factor * np.prod(centre ** (row - power) * half**power, axis=1)
    return T


def _gram(g: ComplexArray, S: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Variances and covariance of the real and imaginary part of functionals g (N, k, n, n) under S (N, k, k)."""
    N, k, n, _ = g.shape
    flat = g.reshape(N, k, n * n)
    x, y = flat.real, flat.imag
    Sx, Sy = S @ x, S @ y
    xx, xy, yy = ((a * b).sum(1).reshape(N, n, n) for a, b in ((x, Sx), (x, Sy), (y, Sy)))
    return xx, xy, yy


def margins(plants: PlantSet, damping: float, low: FloatArray, high: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Margins by which cells are proved: no loop has a pole on their part of the ray of a damping factor.

    Parameters
    ----------
    plants : PlantSet
        The plants.
    damping : float
        Damping factor of the ray.
    low, high : (N, v + 1 + q) array
        Cells: scheduling variables, frequency [rad/s], and shares of the ellipsoid's radius along `directions`.

    Returns
    -------
    (N,) array, (N, v + 1 + q) array
        Margin, positive where F is proved nonsingular; and what each axis contributes to its bounds.
    """
    n, v, k = plants.M.shape[1], plants.box.shape[0], len(plants.coefficients)
    N, mid, half = len(low), (low + high) / 2, (high - low) / 2 * (1 + ROUNDING)
    turn = -damping + 1j * np.sqrt(1 - damping**2)
    # parameters: centre, slopes by s and t, covariance of what remains of the ellipsoid, bounds of all else
    T = local_terms(plants.exponents, mid[:, :v], half[:, :v])
    straight, curved = slice(1, 1 + v), slice(1 + v, None)
    t, dt = mid[:, v + 1 :], half[:, v + 1 :]
    nearest = np.maximum(np.abs(t) - dt, 0.0)
    rest = plants.radius * np.sqrt(np.maximum(1 + ROUNDING - (nearest**2).sum(1), 0.0))
    along = plants.radius * np.einsum("qkt,Nte->Nkqe", plants.directions, T)
    centre = np.einsum("kt,Nte->Nke", plants.coefficients, T) + np.einsum("Nq,Nkqe->Nke", t, along)
    cut = plants.covariance - np.einsum("qkt,qls->ktls", plants.directions, plants.directions)
    TT = np.einsum("Nte,Nse->Nets", T, T).reshape(N, -1, T.shape[1] ** 2)
    by_terms = cut.transpose(1, 3, 0, 2).reshape(T.shape[1] ** 2, k * k)
    S = (TT[:, : 1 + v] @ by_terms).reshape(N, 1 + v, k, k)
    std = np.sqrt(np.maximum(TT @ by_terms.reshape(-1, k, k)[:, range(k), range(k)], 0.0))  # (N, e, k)
    theta = centre[:, :, 0]
    slopes = np.concatenate([centre[:, :, straight], dt[:, None] * along[..., 0]], axis=2)
    bent = np.abs(centre[:, :, curved]).sum(2) + np.einsum("Nq,Nkqe->Nk", dt, np.abs(along[..., 1:]))
    bent += rest[:, None] * std[:, curved].sum(1)
    moved = np.abs(slopes).sum(2) + rest[:, None] * std[:, : 1 + v].sum(1) + bent
    # the known part, its slope by the frequency, and a bound of the rest
    A, B, C, D = plants.H
    lam, dlam = turn * mid[:, v], half[:, v]
    R = np.linalg.inv(lam[:, None, None] * np.eye(len(A)) - A) if len(A) else np.zeros((N, 0, 0), complex)
    CR, RB = C @ R, R @ B
    H, dH = CR @ B + D, -turn * (CR @ RB)
    reach = dlam * np.linalg.norm(R, axis=(1, 2))
    bad = reach >= 1
    RH = np.linalg.norm(CR, axis=2)[:, :, None] * np.linalg.norm(RB, axis=1)[:, None, :]
    RH *= (dlam * reach / np.where(bad, 1.0, 1 - reach))[:, None, None]
    dHbar = np.abs(dH) * dlam[:, None, None] + RH
    # the delays
    M = plants.M[0] + np.einsum("Nk,kij->Nij", theta, plants.M[1:])
    tau, dtau = plants.tau[0] + theta @ plants.tau[1:], moved @ np.abs(plants.tau[1:])
    x = lam[:, None] * tau
    rx = np.abs(lam)[:, None] * dtau + np.abs(tau) * dlam[:, None] + dtau * dlam[:, None]
    p = plants.pade
    delta = (-1.0) ** len(p) * np.prod((x[..., None] + p) / (x[..., None] - p), axis=-1)
    log = np.sum(1 / (x[..., None] + p) - 1 / (x[..., None] - p), axis=-1)
    near = np.concatenate([np.abs(x[..., None] + p), np.abs(x[..., None] - p)], axis=-1) - rx[..., None]
    near = np.maximum(near, 1e-9)
    first, second = (1 / near).sum(-1), (1 / near**2).sum(-1)
    ddelta = delta * log
    bend = np.abs(delta) * np.exp(np.minimum(first * rx, 50.0)) * (first**2 + second) / 2
    ddbar = np.abs(ddelta) * (np.abs(lam)[:, None] * dtau + np.abs(tau) * dlam[:, None])
    lean = np.abs(np.real(turn * np.conj(p)))
    largest = np.prod(np.sqrt((np.abs(p) + lean) / (np.abs(p) - lean)))  # of |delta| on the ray, for any delay
    Rdelta = np.minimum(np.abs(ddelta) * dlam[:, None] * dtau + bend * rx**2, largest + np.abs(delta) + ddbar)
    unit = np.broadcast_to(np.eye(n), (N, n, n))
    Z = np.concatenate([unit, delta[..., None] * H], axis=1)
    RZ = Rdelta[..., None] * (np.abs(H) + dHbar) + np.abs(delta)[..., None] * RH + ddbar[..., None] * dHbar
    dZ = ddbar[..., None] * np.abs(H) + np.abs(delta)[..., None] * (dHbar - RH) + RZ
    by_frequency = turn * (ddelta * tau)[..., None] * H + delta[..., None] * dH
    # in coordinates in which F is nearly diagonal
    F = lam[:, None, None] * np.eye(n) - M @ Z
    finite = np.isfinite(F).all(axis=(1, 2))
    F[~finite] = np.eye(n)
    bad |= ~finite
    mu, V = np.linalg.eig(F)
    V = V + 1e-14 * unit  # of a defective matrix, whose eigenvectors are replaced below
    W = np.linalg.inv(V)
    crossing = np.linalg.norm(V, axis=(1, 2)) * np.linalg.norm(W, axis=(1, 2)) > _SKEW * n
    if crossing.any():
        U, sigma, Vh = np.linalg.svd(F[crossing])
        mu[crossing], V[crossing], W[crossing] = sigma, Vh.conj().swapaxes(1, 2), U.conj().swapaxes(1, 2)
    ZV, MI = Z @ V, M[:, :, n:]
    G = -(W[:, None] @ np.einsum("kij,Njl->Nkil", plants.M[1:], ZV))
    each = np.einsum("Nip,Np,Npj->Npij", W @ MI, ddelta * lam[:, None], H @ V)
    G -= np.einsum("kp,Npij->Nkij", plants.tau[1:], each)
    Gs = np.einsum("Nkij,Nks->Nsij", G, slopes)
    Gw = dlam[:, None, None] * (W @ (turn * np.eye(n) - MI @ by_frequency) @ V)
    line = np.concatenate([Gs[:, :v], Gw[:, None], Gs[:, v:]], axis=1)
    absW, absV = np.abs(W), np.abs(V)
    F2 = np.einsum("Nk,kij->Nij", moved, np.abs(plants.M[1:]))[:, :, n:] @ dZ + np.abs(MI) @ RZ
    size = np.abs(lam)[:, None, None] * np.eye(n) + np.abs(M) @ np.abs(Z)
    bound = absW @ (F2 + ROUNDING * size) @ absV + np.einsum("Nk,Nkij->Nij", bent, np.abs(G))
    diagonal = np.arange(n)
    exact = W @ F @ V
    exact[:, diagonal, diagonal] -= mu
    bound += np.abs(exact)
    low_side = (mu * np.conj(mu / np.abs(mu)))[..., None].real * np.real(_HALF_PLANES)
    planes = (np.conj(mu / np.abs(mu)))[..., None] * np.conj(_HALF_PLANES)  # (N, n, phi)
    cosine, sine = planes.real, -planes.imag
    far = np.zeros((N, n, n))
    for e in range(1 + v):
        xx, xy, yy = _gram(G, S[:, e])
        far += np.sqrt(np.maximum((xx + yy) / 2 + np.sqrt(((xx - yy) / 2) ** 2 + xy**2), 0.0))
        xx, xy, yy = (part[:, diagonal, diagonal][..., None] for part in (xx, xy, yy))
        low_side = low_side - rest[:, None, None] * np.sqrt(
            np.maximum(xx * cosine**2 + 2 * xy * cosine * sine + yy * sine**2, 0.0)
        )
    on_line = line[:, :, diagonal, diagonal]
    low_side = low_side - np.abs(np.real(on_line[..., None] * planes[:, None])).sum(1)
    smallest = low_side.max(-1) - bound[:, diagonal, diagonal]
    off = np.abs(line).sum(1) + rest[:, None, None] * far + bound
    off[:, diagonal, diagonal] = 0.0
    # comparison matrix: an M-matrix if it maps a positive vector to a positive one
    comparison = -off
    comparison[:, diagonal, diagonal] = smallest
    bad |= ~(smallest > 0).all(axis=1) | ~np.isfinite(comparison).all(axis=(1, 2))
    comparison[bad] = unit[0]
    with np.errstate(all="ignore"):
        ratio = off / smallest[:, :, None]
        ratio[bad] = 0.0
        weights = np.linalg.solve(unit - np.minimum(ratio, 1e6), np.ones((N, n, 1)))
    weights = np.where(np.isfinite(weights), weights, 0.0)
    mapped = (comparison @ weights)[..., 0] / np.maximum(smallest * weights[..., 0], 1e-300)
    margin = np.where(bad | ~(weights > 0).all(axis=(1, 2)), -1.0, mapped.min(axis=1) - ROUNDING)
    row = np.argmin(smallest / np.abs(mu), axis=1)
    share = np.abs(line[np.arange(N), :, row]).sum(-1) / np.abs(mu[np.arange(N), row])[:, None]
    share[:, v + 1 :] *= _CUT_LESS
    return margin, np.nan_to_num(share)


# ---- From a design and its identified plant to the set, and loops of the set as numbers.


def plant_set(controller: LinearModel, fit: LPVFit, level: float) -> PlantSet:
    """Return the loops of a controller and of all plants whose coefficients lie in the ellipsoid of a level.

    Raises
    ------
    UsageError
        When the covariance is unknown, the model has no actuators, the channels do not fit, or the matrices of the
        structure are not affine in its parameters.
    """
    model, names = fit.model, fit.estimates.parameters
    where = f"prove: model {model.name!r}"
    if controller.D.shape != (len(model.input_names), len(model.output_names)):
        inputs, outputs = controller.D.shape
        raise UsageError(
            f"{where} has the inputs {', '.join(model.input_names)} and the outputs {', '.join(model.output_names)}; "
            f"the controller drives {inputs} and measures {outputs}"
        )
    law, structure, order = controller, model.structure, PADE_ORDER
    if structure is None:
        if not model.actuators:
            raise UsageError(f"{where} has no actuators; give fit_lpv(..., actuators=...)")
        law, order = _in_series(controller, evaluate(PiezoPair(), model.actuators)), model.pade_order
        structure = RotorBearing(disturbance_gain="none")
    p, m = symbolic_matrices(structure)
    n_u = m.B.shape[1]
    delay = m.delay if m.has_delay else ca.SX(n_u, 1)
    affine = ca.vertcat(ca.vec(ca.horzcat(m.A, m.B, m.B_delayed)), ca.SX(n_u, 1), delay)
    slopes = ca.jacobian(affine, p)
    if m.feedback or ca.depends_on(ca.vertcat(ca.vec(slopes), ca.vec(m.C), ca.vec(m.D)), p) or not m.D.is_zero():
        raise UsageError(f"{where}: a proof needs matrices affine in the parameters and outputs without parameters")
    middle = model.key_parameters(*(sum(bounds) / 2 for bounds in model.domain.bounds))
    every = [parameter.name for parameter in structure.parameters]
    columns, at = [every.index(name) for name in names], np.array([middle[name] for name in every])
    function = ca.Function("affine", [p], [affine, ca.densify(slopes), ca.densify(m.C)])
    value, by, C = (np.array(part, float) for part in function(at))
    parts = np.concatenate([value - by[:, columns] @ at[columns, None], by[:, columns]], axis=1).T
    n, split = len(C.T), len(C.T) * (len(C.T) + 2 * n_u)
    M = parts[:, :split].reshape(len(parts), n + 2 * n_u, n).transpose(0, 2, 1)
    A = M[0] + np.tensordot(at[columns], M[1:], 1)
    unit = scipy.linalg.matrix_balance(A[:, :n], permute=False, separate=True)[1][0]
    M[:, :, :n] *= unit
    M /= unit[:, None]
    used = np.abs(M[:, :, n:]).any(axis=(0, 1))
    tau = parts[:, split:][:, used]
    a, units = scipy.linalg.matrix_balance(law.A, permute=False, separate=True)
    known = (a, law.B @ C * unit / units[0][:, None], np.tile(law.C * units[0], (2, 1))[used])
    H = (*known, np.tile(law.D @ C * unit, (2, 1))[used])
    k, t = fit.coefficients.shape
    poles = np.linalg.eigvals(unit_ladder(order)[0]) if tau.any() else np.zeros(0, complex)
    return PlantSet(
        M[:, :, [*range(n), *(n + np.flatnonzero(used))]],
        tau,
        H,
        poles,
        fit.coefficients,
        np.asarray(fit.covariance, float).reshape(k, t, k, t),
        float(np.sqrt(scipy.special.chdtri(_root(fit.covariance).shape[1], 1 - level))),
        np.zeros((0, k, t)),
        np.array(model.exponents, int).reshape(t, -1),
        np.array(model.domain.bounds, float).reshape(-1, 2),
    )


def _root(covariance: FloatArray) -> FloatArray:
    """Return R with R R' equal to a covariance; as many columns as its rank."""
    root = root_of(np.asarray(covariance, float))
    size = np.sqrt(np.maximum(np.diag(covariance), 0.0))
    weight = np.linalg.norm(root / np.where(size > 0, size, 1.0)[:, None], axis=0)
    return root[:, weight > 1e-7 * max(weight.max(initial=0.0), 1e-300)]


def _in_series(first: LinearModel, second: LinearModel) -> LinearModel:
    """Return the model from the inputs of the first to the outputs of the second."""
    A = np.block([[first.A, np.zeros((first.n_states, second.n_states))], [second.B @ first.C, second.A]])
    B = np.vstack([first.B, second.B @ first.D])
    return LinearModel(A, B, np.hstack([second.D @ first.C, second.C]), second.D @ first.D)


def loop_matrix(plants: PlantSet, theta: FloatArray) -> FloatArray:
    """Return the state matrix of the loop with Padé delays for the parameters theta (k,)."""
    M, tau = plants.M[0] + np.tensordot(theta, plants.M[1:], 1), plants.tau[0] + theta @ plants.tau[1:]
    A, B, C, D = plants.H
    n, order = len(M), len(plants.pade)
    late = np.flatnonzero(tau)
    edge = n + len(A)
    loop = np.zeros((edge + order * len(late),) * 2)
    loop[:n, :n], loop[n:edge, :n], loop[n:edge, n:edge] = M[:, :n], B, A
    output = np.zeros((len(C), len(loop)))
    output[:, :n], output[:, n:edge] = D, C
    for i in range(len(C)):
        if i not in late:
            loop[:n] += M[:, [n + i]] @ output[[i]]
            continue
        a, b, c, d = unit_ladder(order)
        own = slice(edge + order * int(np.searchsorted(late, i)), edge + order * int(np.searchsorted(late, i) + 1))
        loop[own] = b / tau[i] @ output[[i]]
        loop[own, own] += a / tau[i]
        loop[:n] += M[:, [n + i]] @ (d * output[[i]])
        loop[:n, own] += M[:, [n + i]] @ c
    return loop


# ---- Attack: a plant of the set with little damping.


def _theta(plants: PlantSet, point: FloatArray, coefficients: FloatArray) -> FloatArray:
    return np.asarray(coefficients @ np.prod(point**plants.exponents, axis=1))


def _damping(plants: PlantSet, point: FloatArray, coefficients: FloatArray) -> float:
    """Smallest damping factor of all poles; 1 for a real stable one, -1 for an unstable one or a negative delay."""
    theta = _theta(plants, point, coefficients)
    if ((plants.tau[0] + theta @ plants.tau[1:]) < 0).any():
        return 1.0  # no plant of the set
    poles = np.linalg.eigvals(loop_matrix(plants, theta))
    return float((-poles.real / np.maximum(np.abs(poles), 1e-300)).min())


def _steepest(
    plants: PlantSet, root: FloatArray, point: FloatArray, coefficients: FloatArray, rank: int = 0
) -> FloatArray:
    """Return the direction (in units of the root) in which the damping of the mode of a rank falls fastest."""
    theta = _theta(plants, point, coefficients)
    A = loop_matrix(plants, theta)
    poles, V = np.linalg.eig(A)
    order = np.argsort(np.where(poles.imag >= 0, -poles.real / np.abs(poles), np.inf))
    i = order[min(rank, len(order) - 1)]
    pole, w = poles[i], np.linalg.inv(V)[i]
    slope = np.zeros(len(theta))
    for j, value in enumerate(theta):
        moved = theta.copy()
        moved[j] += (step := 1e-6 * max(abs(value), 1e-12))
        change = w @ (loop_matrix(plants, moved) - A) @ V[:, i] / step
        slope[j] = -change.real / abs(pole) + pole.real * (np.conj(pole) * change).real / abs(pole) ** 3
    down = -root.T @ np.outer(slope, np.prod(point**plants.exponents, axis=1)).ravel()
    return np.asarray(down / max(float(np.linalg.norm(down)), 1e-300))


def _attack(
    plants: PlantSet, enough: float = 0.0, rounds: int = 12
) -> tuple[float, FloatArray, FloatArray, FloatArray]:
    """Search the worst plant, or one at or below `enough`.

    Return its damping, point and coefficients, and directions in which to cut the ellipsoid.
    """
    k, t = plants.coefficients.shape
    root = _root(plants.covariance.reshape(k * t, k * t))
    low, high = plants.box.T
    corners = [*product(*plants.box), plants.box.mean(axis=1)]
    best = (np.inf, low, plants.coefficients, np.zeros(root.shape[1]))
    for start, rank in product(dict.fromkeys(map(tuple, corners)), (0, 1)):
        point, u = np.array(start, float), np.zeros(root.shape[1])
        value = _damping(plants, point, plants.coefficients)
        for turn in range(rounds):
            before = value
            here = plants.coefficients + (root @ u).reshape(k, t)
            down = plants.radius * _steepest(plants, root, point, here, rank if turn == 0 else 0)
            for share in (1.0,) if rank and turn == 0 else (1.0, 0.5, 0.2):
                trial = u + share * (down - u)
                there = plants.coefficients + (root @ trial).reshape(k, t)
                reached = _damping(plants, point, there)
                if reached < value or (rank and turn == 0):
                    u, here, value = trial, there, reached
                    break
            for step in 0.25 * 0.5 ** np.arange(6):
                for side in (*np.eye(len(low)), *-np.eye(len(low))):
                    moved = np.clip(point + step * side * (high - low), low, high)
                    if (reached := _damping(plants, moved, here)) < value:
                        point, value = moved, reached
            if value <= enough or (turn > 0 and value > before - 1e-5 * abs(before)):
                break
        if value < best[0]:
            best = (value, point, plants.coefficients + (root @ u).reshape(k, t), u)
        if value <= enough:
            break
    value, point, worst, u = best
    vectors = [u, *(_steepest(plants, root, point, worst, rank) for rank in (0, 1))]
    frame: list[FloatArray] = []
    for vector in vectors:
        rest = vector - sum((f * (f @ vector) for f in frame), np.zeros(len(vector)))
        if np.linalg.norm(rest) > 0.05 * max(float(np.linalg.norm(vector)), 1e-300) and len(frame) < 2:
            frame.append(rest / np.linalg.norm(rest))
    return value, point, worst, np.array([(root @ f).reshape(k, t) for f in frame]).reshape(-1, k, t)


# ---- Proof: the ray of a damping factor is free of poles, cell by cell.


def _last_frequency(plants: PlantSet, damping: float) -> float:
    """Frequency [rad/s] from which on the ray is free of poles for every plant, by the size of M and H."""
    top = np.abs(plants.box).max(axis=1)
    terms = np.prod(top**plants.exponents, axis=1)
    k, t = plants.coefficients.shape
    std = np.sqrt(np.maximum(np.diag(plants.covariance.reshape(k * t, k * t)), 0.0)).reshape(k, t)
    M = np.abs(plants.M[0]) + np.tensordot(
        (np.abs(plants.coefficients) + plants.radius * std) @ terms, np.abs(plants.M[1:]), 1
    )
    A, B, C, D = plants.H
    n, frequency = len(M), 1.0
    turn = -damping + 1j * np.sqrt(1 - damping**2)
    while frequency < 1e12:
        room = frequency - np.linalg.norm(A)
        if room > 0:
            H = np.abs(D) + np.outer(np.linalg.norm(C, axis=1), np.linalg.norm(B, axis=0)) / room
            Z = np.vstack([np.eye(n), _largest_delay_gain(plants.pade, turn) * H])
            if np.linalg.norm(np.abs(np.linalg.eigvals(M @ Z)), np.inf) < 0.99 * frequency:
                return frequency
        frequency *= 2
    raise UsageError("prove: the loop has direct feedthrough at all frequencies; give the controller a low-pass")


def _largest_delay_gain(pade: ComplexArray, turn: complex) -> float:
    """Largest gain of the Padé approximation on a ray, for any delay."""
    lean = np.abs(np.real(turn * np.conj(pade)))
    return float(np.prod(np.sqrt((np.abs(pade) + lean) / (np.abs(pade) - lean))))


def _cells(plants: PlantSet, low: FloatArray, high: FloatArray, damping: float) -> tuple[FloatArray, FloatArray]:
    """Return cells of the unit cube in physical units."""
    v, last = len(plants.box), _last_frequency(plants, damping)
    middle = _theta(plants, plants.box.mean(axis=1), plants.coefficients)
    typical = float(np.abs(np.linalg.eigvals(loop_matrix(plants, middle))).min())
    share = last / (typical + last)

    def physical(x: FloatArray) -> FloatArray:
        place = plants.box[:, 0] + x[:, :v] * (plants.box[:, 1] - plants.box[:, 0])
        frequency = typical * share * x[:, v] / (1 - share * x[:, v])
        return np.column_stack([place, frequency, 2 * x[:, v + 1 :] - 1])

    return physical(low), physical(high)


def _split(low: FloatArray, high: FloatArray, axes: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Halve cells, each along its axis: first all lower halves, then all upper ones."""
    row = np.arange(len(axes))
    upper, lower = low.copy(), high.copy()
    upper[row, axes] = lower[row, axes] = (low[row, axes] + high[row, axes]) / 2
    return np.concatenate([low, upper]), np.concatenate([lower, high])


_CHUNK = 1000


def _checked(plants: PlantSet, damping: float, low: FloatArray, high: FloatArray) -> tuple[FloatArray, FloatArray]:
    parts = []
    for i in range(0, len(low), _CHUNK):
        parts.append(margins(plants, damping, *_cells(plants, low[i : i + _CHUNK], high[i : i + _CHUNK], damping)))
    return np.concatenate([m for m, _ in parts]), np.concatenate([s for _, s in parts])


def _starts_inside(plants: PlantSet, damping: float) -> bool:
    """Whether the central loop has more damping, and neither the known part nor a delay has a pole on the ray."""
    point = plants.box.mean(axis=1)
    known = np.concatenate([np.linalg.eigvals(plants.H[0]), plants.pade])
    apart = np.abs(-known.real / np.maximum(np.abs(known), 1e-300) - damping)
    theta = _theta(plants, point, plants.coefficients)
    positive = bool(((plants.tau[0] + theta @ plants.tau[1:]) >= 0).all())
    return bool(positive and (apart > 1e-9).all() and _damping(plants, point, plants.coefficients) > damping)


def _search(plants: PlantSet, damping: float, deadline: float) -> FloatArray | None:
    """Return the axes of splits in level order, -1 for a proved cell; None when no proof is found in time."""
    if not _starts_inside(plants, damping):
        return None
    axes = len(plants.box) + 1 + len(plants.directions)
    low, high = np.zeros((1, axes)), np.ones((1, axes))
    splits: list[FloatArray] = []
    while len(low):
        level = []
        for i in range(0, len(low), _CHUNK):
            if monotonic() > deadline or sum(len(each) for each in splits) + len(low) > _MOST_CELLS:
                return None
            margin, share = _checked(plants, damping, low[i : i + _CHUNK], high[i : i + _CHUNK])
            level.append(np.where(margin > 0, -1, share.argmax(axis=1)))
        splits.append(np.concatenate(level))
        open_cells = splits[-1] >= 0
        low, high = _split(low[open_cells], high[open_cells], splits[-1][open_cells])
    return np.concatenate(splits).astype(np.int8)


_MOST_CELLS = 400_000
_GAPS = (0.4, 0.2, 0.1, 0.05)
"""Relative distances of proof and attack that are tried in turn; loose proofs need few cells."""


class ProofStatus(StrEnum):
    """Outcome of a proof."""

    PROVED = "proved"
    """Every loop of the set has at least the required damping."""
    REFUTED = "refuted"
    """A plant of the set has less than the required damping: `worst`."""
    UNDECIDED = "undecided"
    """No plant with less was found, but the damping that could be proved is smaller than required."""


@dataclass(frozen=True)
class WorstPlant(Brief):
    """Plant of the set with the least damping that was found.

    Attributes
    ----------
    damping : float
        Smallest damping factor of its loop; negative when it is unstable.
    point : dict of str to float
        Operating point.
    coefficients : dict of str to floats
        Coefficients of its surfaces, as in `LPVModel.coefficients`.
    """

    damping: float
    point: Mapping[str, float]
    coefficients: Mapping[str, tuple[float, ...]]

    @property
    def where(self) -> str:
        """Operating point in words."""
        return ", ".join(f"{name} {value:.5g}" for name, value in self.point.items()) or "all points"


@dataclass(frozen=True, eq=False)
class Proof(Brief):
    r"""Lower bound of the closed-loop damping over all plants of an identified set, with its certificate.

    Attributes
    ----------
    damping : float
        Proved damping factor of every loop of the set; nan when none was proved.
    status : ProofStatus
        Whether `damping` reaches `least`.
    least : float
        Required damping factor.
    level : float
        Level of the ellipsoid of the coefficients.
    nominal : float
        Damping at the centre of the ellipsoid, smallest over the operating points tried.
    worst : WorstPlant
        Plant with the least damping that an attack by gradients found.
    seconds : float
        Time of attack and proof [s].
    directions : (q, k, t) array
        Directions in the coefficients along which the ellipsoid was cut.
    splits : (n,) array
        Certificate: axis along which each cell was halved, in level order; -1 for a cell that was proved as it is.
    digest : str
        Checksum of the certificate and of what it is about.
    controller, model : LinearModel, LPVFit
        The loop.
    """

    damping: float
    status: ProofStatus
    least: float
    level: float
    nominal: float
    worst: WorstPlant
    seconds: float
    directions: FloatArray
    splits: FloatArray
    digest: str
    controller: LinearModel
    model: LPVFit

    @property
    def cells(self) -> int:
        """Number of cells that were proved one by one."""
        return int((self.splits < 0).sum())

    @property
    def assumptions(self) -> str:
        """What was assumed, in words."""
        ranges = ", ".join(f"{name} {a:g} to {b:g}" for name, (a, b) in self.model.model.domain.ranges.items())
        return (
            f"coefficients in their {100 * self.level:g} % ellipsoid; {ranges}; operating point constant; "
            "continuous loop with Padé delays; structure and actuators as in the model"
        )

    @property
    def sentence(self) -> str:
        """The result in one sentence."""
        if self.status is ProofStatus.REFUTED:
            return f"refuted: damping {self.worst.damping:.4f} at {self.worst.where}"
        proved = "none proved" if np.isnan(self.damping) else f"proved {self.damping:.4f}"
        return f"{self.status}: damping {proved}, worst found {self.worst.damping:.4f} at {self.worst.where}"

    def _brief(self) -> Description:
        return brief(
            self,
            self.sentence,
            nominal=f"{self.nominal:.4f}",
            required=f"{self.least:g}",
            assumed=self.assumptions,
            cells=f"{self.cells}, {self.seconds:.3g} s",
        )

    def verify(self) -> bool:
        """Check the certificate anew, without the search: True if `damping` holds for every plant of the set.

        The plants are built again from `controller` and `model`. Then the check follows four steps: the directions are
        conjugate semi-axes of the ellipsoid; the loop in the middle has more damping; the cells fill the whole set; in
        each cell no pole can lie on the ray of the damping factor.
        """
        splits = np.asarray(self.splits)
        if splits.ndim != 1 or not len(splits) or not 0 <= self.damping < 1 or self._checksum() != self.digest:
            return False
        plants = replace(plant_set(self.controller, self.model, self.level), directions=self.directions)
        root = _root(self.model.covariance)
        axes = self.directions.reshape(len(self.directions), -1).T
        std = np.linalg.norm(root, axis=1)[:, None]
        root, axes = root / np.where(std > 0, std, 1.0), axes / np.where(std > 0, std, 1.0)
        inside = np.linalg.lstsq(root, axes, rcond=1e-13)[0]
        size = np.abs(root) @ np.abs(inside) + 1e-300
        if (np.abs(root @ inside - axes) > 1e-6 * size).any() or not np.allclose(
            inside.T @ inside, np.eye(axes.shape[1]), atol=1e-7
        ):
            return False
        if not _starts_inside(plants, self.damping):
            return False
        dimension = len(plants.box) + 1 + len(self.directions)
        low, high = np.zeros((1, dimension)), np.ones((1, dimension))
        while len(low):
            level, splits = splits[: len(low)], splits[len(low) :]
            if len(level) < len(low) or (level >= dimension).any():
                return False
            closed = level < 0
            if closed.any() and not (_checked(plants, self.damping, low[closed], high[closed])[0] > 0).all():
                return False
            low, high = _split(low[~closed], high[~closed], level[~closed].astype(int))
        return not len(splits)

    def _checksum(self) -> str:
        law, fit = self.controller, self.model
        parts = (self.damping, self.level, self.directions, self.splits, law.A, law.B, law.C, law.D)
        data = (*parts, fit.coefficients, fit.covariance, fit.model.domain.bounds, [*fit.model.actuators.values()])
        return hashlib.sha256(b"".join(np.asarray(part, float).tobytes() for part in data)).hexdigest()


def prove(
    design: GainResult | ControllerDesign | LinearModel,
    model: LPVFit,
    level: Annotated[Finite, Gt(0), Lt(1)] = 0.95,
    rates: Mapping[str, float] | None = None,
    seconds: Positive = 30.0,
    *,
    least: Annotated[Finite, Ge(0), Lt(1)] = 0.0,
) -> Proof:
    r"""Prove a damping factor for the loops of a design with all plants of an identified set.

    Parameters
    ----------
    design : GainResult, ControllerDesign or LinearModel
        Continuous controller with constant gains.
    model : LPVFit
        Identified surfaces with the covariance of their coefficients. The set is the ellipsoid of all coefficients
        together, over the whole domain of the model.
    level : float
        Probability of the ellipsoid, for normally distributed coefficients.
    rates : dict of str to float, optional
        Rates of the scheduling variables. Not built: only constant operating points are proved.
    seconds : float
        Time after which the search for a proof ends [s]; it ends earlier when proof and attack differ by 5 %.
    least : float
        Required damping factor, by which the status is decided; 0 requires stability.

    Returns
    -------
    Proof

    Raises
    ------
    UsageError
        When the design is sampled or scheduled, rates are given, or the model is not affine in its parameters.

    Notes
    -----
    A pole leaves the sector of a damping factor only across the ray :math:`\lambda = \omega e^{j \psi}`. With delays
    and the known part of the loop eliminated, a loop has a pole there if a small matrix :math:`F(\lambda, \theta)` is
    singular. In a cell of operating points, frequencies and coefficients, F is expanded to first order around the
    middle in the coordinates of its eigenvectors. First-order terms are bounded exactly over the ellipsoid, all others
    by their absolute values. Where the matrix of the bounds is an M-matrix, F is nonsingular. Other cells are halved.
    """
    begin = monotonic()
    if rates:
        raise UsageError("prove: rates are not supported; a proof is for constant operating points (leave rates out)")
    if not isinstance(model, LPVFit):
        raise UsageError(f"prove: a {type(model).__name__} has no covariance of surfaces; give the result of fit_lpv")
    controller = _controller(design)
    plants = plant_set(controller, model, level)
    worst, point, coefficients, directions = _attack(plants, np.nextafter(least, -1.0) if least else 0.0)
    plants = replace(plants, directions=directions)
    corners = [np.array(corner) for corner in product(*plants.box)]
    places = [*corners, point, *np.array(model.model.operating_points, float).reshape(-1, len(plants.box))]
    nominal = min(_damping(plants, place, plants.coefficients) for place in places)
    damping, splits = nan, np.zeros(0)
    gaps = list(_GAPS)
    while gaps and worst > max(least, 0.0) and monotonic() - begin < seconds:
        gap = gaps.pop(0)
        left = seconds - (monotonic() - begin)
        proof = _search(plants, target := (1 - gap) * worst, monotonic() + left / 2)
        if proof is not None:
            damping, splits = target, proof
        elif np.isnan(damping) and gap < 1:
            gaps = [0.7 if gap < 0.7 else 1.0]
        else:
            break
    status = ProofStatus.REFUTED if worst < least or worst <= 0 else ProofStatus.UNDECIDED
    if damping >= least:
        status = ProofStatus.PROVED
    names = model.estimates.parameters
    rows = {name: tuple(map(float, row)) for name, row in zip(names, coefficients, strict=True)}
    plant = WorstPlant(worst, dict(zip(model.model.scheduling, map(float, point), strict=True)), rows)
    result = Proof(
        damping, status, least, level, nominal, plant, monotonic() - begin, directions, splits, "", controller, model
    )
    return replace(result, digest=result._checksum())


def _controller(design: Any) -> LinearModel:
    """Return the continuous controller of a design; refuses sampled and scheduled ones."""
    if isinstance(design, LinearModel):
        if design.dt is not None:
            raise UsageError("prove: the controller is sampled; sampled loops are not supported, give a continuous one")
        return design
    if not isinstance(design, GainResult | ControllerDesign):
        raise UsageError(f"prove: design = {type(design).__name__}; give a result of gbid.tune or a LinearModel")
    structure = design.controller if isinstance(design, GainResult) else design.structure
    if isinstance(design, GainResult) and design.sample_time is not None:
        raise UsageError(
            "prove: the design is for a sampled loop; sampled loops are not supported, tune without sample_time"
        )
    if structure is None or isinstance(structure, Scheduled):
        raise UsageError("prove: a proof needs a structure with constant gains; scheduled gains are not supported")
    return controller_model(structure, design.gains)
