r"""Gas film of a controllable bearing by the Reynolds equation: rates in C, equilibrium, linearisation, modes.

The film is not of the structure that gbid fits. Its state is the gas in each cell of the unrolled half of the bearing:

.. math::

    \frac{\partial (p h)}{\partial t} = \nabla \cdot \left(\frac{p h^3}{12 \mu} \nabla p\right)
        - \frac{U}{2} \frac{\partial (p h)}{\partial x} + R T \dot m, \qquad h = c - X \cos\theta - Y \sin\theta

The gas is ideal and isothermal (Hamrock, *Fundamentals of Fluid Film Lubrication*, ch. 16). Finite volumes conserve
the gas exactly. Four injectors feed the film at the mid-plane through ducts whose pins the piezos move. The flow at a
pin is that of a nozzle, choked below the critical pressure ratio; the gas in the duct has the pressure of the film.
"""

from __future__ import annotations

import ctypes
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
import scipy

from gbid.core.arrays import FloatArray, frequencies_and_dampings, one_blas_thread
from gbid.core.compiled import load_library
from gbid.core.errors import UsageError
from gbid.core.option_types import Count, NotNegative, Positive, check_options

GAS_CONSTANT, HEAT_RATIO, AMBIENT_PA = 287.05, 1.4, 101325.0
"""Air: specific gas constant [J/(kg K)] and ratio of heats; pressure around the bearing [Pa]."""

N_NUMBERS = 17
"""Numbers before the tables of the C code."""

MAX_STAGES = 80
"""Largest number of stages of a Runge-Kutta-Chebyshev step; it is stable to 4 200/h."""


@dataclass(frozen=True)
class GasFilm:
    """Compressible gas film with four injectors, in place of the linear bearing of Eq. 5.

    Length, diameter and orifice are those of Table 1. The paper does not give the other values: they are plausible
    ones, chosen for modes at some tens to 150 Hz that are stable at 5 to 7 bar up to 6000 rpm. No figure of the paper
    was fitted.

    Parameters
    ----------
    length_m, diameter_m : float
        Length and diameter of the bearing [m].
    orifice_diameter_m : float
        Diameter of the ducts where they meet the film [m].
    duct_length_m : float
        Length of each duct from pin to film [m]. Its gas delays the pressure build-up.
    seat_diameter_m : float
        Diameter of the seat that a pin closes [m]. The flow area is the cylinder between seat and pin.
    opening_m : float
        Distance of each pin from its seat when the stacks are at their offset [m].
    discharge : float
        Discharge coefficient of the pins.
    viscosity, temperature_k : float
        Viscosity [Pa s] and temperature [K] of the gas.
    gravity : float
        Weight per moving mass, along -y [m/s^2].
    around, along : int
        Cells around the bearing, a multiple of four, and from the mid-plane to the end.

    Raises
    ------
    UsageError
        When a value is not allowed.
    """

    length_m: Positive = 0.04
    diameter_m: Positive = 0.04
    orifice_diameter_m: Positive = 2e-3
    duct_length_m: NotNegative = 6.4e-3
    seat_diameter_m: Positive = 0.1e-3
    opening_m: Positive = 22.5e-6
    discharge: Positive = 0.6
    viscosity: Positive = 1.82e-5
    temperature_k: Positive = 293.15
    gravity: NotNegative = 9.81
    around: Count = 48
    along: Count = 8

    def __post_init__(self) -> None:
        check_options(self, "film")
        if self.around % 4 or self.along < 2:
            raise UsageError(f"film: around = {self.around}, along = {self.along}; give a multiple of 4 and at least 2")

    @property
    def radius(self) -> float:
        """Radius of the bearing [m]."""
        return self.diameter_m / 2

    @property
    def steps(self) -> tuple[float, float]:
        """Grid spacing around and along the bearing [m]."""
        return np.pi * self.diameter_m / self.around, self.length_m / 2 / self.along


@dataclass(frozen=True)
class FilmPoint:
    """Gas film at an operating point.

    Parameters
    ----------
    film : GasFilm
        The film.
    pressure_bar : float
        Supply pressure above the ambient one [bar].
    speed : float
        Speed of the shaft [rad/s].
    clearance, mass : float
        Radial clearance [m] and moving mass [kg].
    """

    film: GasFilm
    pressure_bar: float
    speed: float
    clearance: float
    mass: float

    @property
    def steps(self) -> tuple[float, float]:
        """Grid spacing around and along the bearing [m]."""
        return self.film.steps

    def arrays(self, centre: FloatArray, rest: FloatArray) -> tuple[np.ndarray, FloatArray]:
        """Return the constants of the C code.

        Parameters
        ----------
        centre : (2,) array
            Position of the journal from which its states count [m].
        rest : (4,) array
            Positions of the stacks at which the pins are open by `opening_m` [m].

        Returns
        -------
        (3 + 2 n,) integer array
            Cells around and along, number of links, injector and cell of each link.
        (n,) array
            Numbers in the order of the enum in the C code, then tables.
        """
        film, (dx, dz), (pairs, parts) = self.film, self.steps, mouths(self.film)
        supply, rt = AMBIENT_PA + 1e5 * self.pressure_bar, GAS_CONSTANT * film.temperature_k
        areas = dx * dz * np.where(pairs[:, 1] < film.around, 0.5, 1.0)
        pocket = np.zeros(film.around * film.along)
        duct = np.pi / 4 * film.orifice_diameter_m**2 * film.duct_length_m
        np.add.at(pocket, pairs[:, 1], duct / 2 * parts / areas)
        flow = film.discharge * np.pi * film.seat_diameter_m * supply * np.sqrt(rt) / 2  # into the half bearing
        theta = np.arange(film.around) * (2 * np.pi / film.around)
        faces = theta + np.pi / film.around
        numbers = [self.clearance, 0.02 * self.clearance, 1 / self.mass, film.gravity, supply, AMBIENT_PA]
        numbers += [dx, dz, 1 / (24 * film.viscosity), flow, film.opening_m, *centre, *rest]
        tables = [np.cos(theta), np.sin(theta), np.cos(faces), np.sin(faces), pocket, parts, parts / areas]
        integers = np.concatenate([[film.around, film.along, len(parts)], pairs.ravel()])
        return np.asarray(integers, ctypes.c_long), np.concatenate([numbers, *tables])

    def rates(self, state: FloatArray, stacks: FloatArray, force: FloatArray) -> FloatArray:
        """Return the time derivatives of position, velocity and gas for a journal at absolute positions.

        Parameters
        ----------
        state : (4 + n_cells,) array
            Position [m] and velocity [m/s] of the journal, then p h of the cells, mid-plane first [Pa m].
        stacks : (4,) array
            Positions of the stacks from their offset [m].
        force : (2,) array
            Further force per mass [m/s^2].
        """
        function = load_library(FILM_SOURCE).gbid_film_rates
        function.restype = None
        integers, numbers = _absolute(self)
        out = np.empty_like(state)
        speed = ctypes.c_double(self.speed * self.film.radius)
        given = (np.ascontiguousarray(a, dtype=float) for a in (numbers, state, stacks, force))
        held = [integers, *given]
        function(*(ctypes.c_void_p(a.ctypes.data) for a in held), speed, ctypes.c_void_p(out.ctypes.data))
        return out

    def check_stable(self) -> None:
        """Check that the rotor on its film is stable without control.

        Raises
        ------
        UsageError
            When it is not, or when the film does not carry the rotor.
        """
        worst = max(film_poles(self), key=lambda s: float(s.real))
        if worst.real >= 0:
            raise UsageError(f"film: unstable at {self.pressure_bar:g} bar and {self.speed:.4g} rad/s, {worst:.4g} 1/s")

    def modes(self) -> FloatArray:
        """Return natural frequency [Hz] and damping factor of the two modes of the rotor, lower frequency first."""
        return rotor_modes(film_poles(self))

    def at_frequency(self, frequency_hz: float) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray]:
        """Return K, D, B per mass and delays that reproduce the response of the film at one frequency.

        No parameters of Eq. 5 have the response of a film at all frequencies.

        Parameters
        ----------
        frequency_hz : float
            The frequency [Hz].
        """
        A, B = linearised(self)
        s = 2j * np.pi * frequency_hz
        gas = np.linalg.solve(s * np.eye(len(A) - 4) - A[4:, 4:], np.hstack([A[4:, :2] + s * A[4:, 2:4], B[4:]]))
        film = A[2:4, :2] + s * A[2:4, 2:4] + A[2:4, 4:] @ gas[:, :2]
        push = A[2:4, 4:] @ gas[:, 2:]
        delay = np.mod(-np.angle(np.diag(push)), 2 * np.pi) / s.imag
        return film.real, film.imag / s.imag, (push * np.exp(s * delay)).real, delay


@lru_cache(maxsize=64)
def mouths(film: GasFilm) -> tuple[np.ndarray, FloatArray]:
    r"""Return the cells fed by each injector, with the share of its flow in each cell.

    Pressure around a source rises with the logarithm of its size, so one cell of 2.6 mm fed alone is not a mouth of
    2 mm. The flow is spread over the cells of a disc whose radius gives the mean pressure over the fed cells,
    :math:`\sum_k |s_k|^2 / \lambda_k`, of the mouth itself, :math:`\sum_k |2 J_1(kR)/(kR)|^2 / k^2`: :math:`s` is the
    Fourier transform of the parts and :math:`\lambda` of the five-point Laplacian. Cells too coarse for any disc with
    this pressure (one cell gives less) feed that of the mouth's own radius.

    Returns
    -------
    (n, 2) integer array
        Injector and cell.
    (n,) array
        Part of the injector's flow.
    """
    from scipy.optimize import brentq  # half a second, which a rig without a film does not need

    (dx, dz), R, (rows, columns) = film.steps, film.orifice_diameter_m / 2, (2 * film.along, film.around)
    grid = (np.arange(200) + 0.5) / 100 - 1
    x, z = (a.ravel() for a in np.meshgrid(grid, grid))
    x, z = (a[np.hypot(x, z) < 1] for a in (x, z))
    sines = [4 * np.sin(np.pi * np.arange(n) / n) ** 2 / d**2 for n, d in ((rows, dz), (columns, dx))]
    laplacian = sines[0][:, None] + sines[1]
    k = np.hypot(*np.meshgrid(*(2 * np.pi / (n * d) * np.arange(-400, 401) for n, d in ((rows, dz), (columns, dx)))))
    laplacian[0, 0] = k[400, 400] = np.inf  # the mean is not part of it
    k_R = np.where(np.isfinite(k), k * R, 1.0)
    mouth = np.sum((2 * scipy.special.j1(k_R) / (k_R * k)) ** 2)

    def cells(radius: float) -> tuple[np.ndarray, np.ndarray]:
        return np.round(radius * z / dz).astype(int), np.round(radius * x / dx).astype(int)

    def excess(radius: float) -> float:
        parts = np.zeros((rows, columns))
        np.add.at(parts, tuple(c % n for c, n in zip(cells(radius), parts.shape, strict=True)), 1 / len(x))
        return float(np.sum(np.abs(np.fft.fft2(parts)) ** 2 / laplacian) - mouth)

    widest = 0.4 * min(film.length_m, np.pi * film.diameter_m / 4)
    fits = excess(0.0) > 0 > excess(widest)
    row, column = cells(brentq(excess, 0.0, widest, xtol=1e-6) if fits else R)
    quarter, pairs, shares = film.around // 4, [], []
    for injector, turn in enumerate((1, 0, 3, 2)):  # 2 moves the disc along +x when it closes, 1 along +y
        fed, counts = np.unique(np.abs(row) * film.around + (column + turn * quarter) % film.around, return_counts=True)
        pairs += [(injector, cell) for cell in fed]
        shares += list(counts / counts.sum())
    return np.array(pairs), np.array(shares)


@lru_cache(maxsize=64)
def film_poles(point: FilmPoint) -> np.ndarray:
    """Return the poles of the rotor on its film, without actuators [1/s]."""
    with one_blas_thread():
        return np.asarray(np.linalg.eigvals(linearised(point)[0]))


def rotor_modes(poles: np.ndarray) -> FloatArray:
    """Return natural frequency [Hz] and damping factor of the two least damped poles, lower frequency first, (2, 2)."""
    rows = frequencies_and_dampings(poles[poles.imag > 0])
    rows = rows[np.argsort(rows[:, 1])][:2]
    return np.asarray(rows[np.argsort(rows[:, 0])])


@lru_cache(maxsize=64)
def _absolute(point: FilmPoint) -> tuple[np.ndarray, FloatArray]:
    return point.arrays(np.zeros(2), np.zeros(4))


@lru_cache(maxsize=64)
def equilibrium(point: FilmPoint) -> FloatArray:
    """Return the equilibrium of rotor and film under the weight, by Newton's method, as read-only arrays.

    Raises
    ------
    UsageError
        When the film does not carry the rotor within its clearance.
    """
    still, free = np.zeros(4), np.zeros(2)
    scale = _scale(point)
    state = np.concatenate([still, scale[4:]])
    for begin in (4, 0):  # first the gas around a journal in the centre
        for _ in range(60):
            A = _jacobian(point, state)[begin:, begin:]
            with one_blas_thread():
                step = -np.linalg.solve(A, point.rates(state, still, free)[begin:])
            largest = float(np.max(np.abs(step) / scale[begin:]))
            state[begin:] += step * min(1.0, 0.2 / largest)
            if largest < 1e-9 or not np.isfinite(largest):
                break
        if not largest < 1e-9 or np.hypot(*state[:2]) >= 0.95 * point.clearance:
            raise UsageError(f"film: no state of rest at {point.pressure_bar:g} bar; change the injectors or the load")
    state.setflags(write=False)
    return state


@lru_cache(maxsize=64)
def linearised(point: FilmPoint) -> tuple[FloatArray, FloatArray]:
    """Return A (n, n) and B of u (n, 2) of small motions about the equilibrium, by central differences."""
    state, free, size = equilibrium(point), np.zeros(2), 1e-8
    pairs = size / 2 * np.array([[0.0, 1.0, 0.0, -1.0], [1.0, 0.0, -1.0, 0.0]])  # of u_x and u_y (Eq. 2)
    B = [(point.rates(state, y, free) - point.rates(state, -y, free)) / (2 * size) for y in pairs]
    return _jacobian(point, state), np.column_stack(B)


def _scale(point: FilmPoint) -> FloatArray:
    """Return the scale of each state: the clearance, a velocity, and the gas of a cell at twice the ambient."""
    integers, numbers = _absolute(point)
    pocket = numbers[N_NUMBERS + 4 * integers[0] :][: integers[0] * integers[1]]
    return np.concatenate(
        [point.clearance * np.array([1.0, 1.0, 1e3, 1e3]), 2 * AMBIENT_PA * (point.clearance + pocket)]
    )


def _jacobian(point: FilmPoint, state: FloatArray) -> FloatArray:
    still, free, columns = np.zeros(4), np.zeros(2), []
    for k, size in enumerate(1e-5 * _scale(point)):
        up, down = state.copy(), state.copy()
        up[k] += size
        down[k] -= size
        columns.append((point.rates(up, still, free) - point.rates(down, still, free)) / (2 * size))
    return np.column_stack(columns)


@lru_cache(maxsize=1)
def chebyshev_table() -> FloatArray:
    """Return the coefficients of second-order Runge-Kutta-Chebyshev steps of 2 to `MAX_STAGES` stages.

    Sommeijer, Shampine, Verwer, RKC: an explicit solver for parabolic PDEs (1997), Eqs. 2.3 to 2.9.

    Returns
    -------
    (MAX_STAGES + 1, MAX_STAGES + 1, 5) array
        mu, nu, mu~, gamma~ and c of stage j in steps of s stages.
    """
    table = np.zeros((MAX_STAGES + 1, MAX_STAGES + 1, 5))
    for s in range(2, MAX_STAGES + 1):
        w0 = 1 + 2 / 13 / s**2
        T, dT, ddT = [1.0, w0], [0.0, 1.0], [0.0, 0.0]
        for j in range(2, s + 1):
            T.append(2 * w0 * T[-1] - T[j - 2])
            dT.append(2 * T[j - 1] + 2 * w0 * dT[-1] - dT[j - 2])
            ddT.append(4 * dT[j - 1] + 2 * w0 * ddT[-1] - ddT[j - 2])
        w1 = dT[s] / ddT[s]
        b = [ddT[j] / dT[j] ** 2 if j > 1 else 0.0 for j in range(s + 1)]
        b[0] = b[1] = b[2]
        table[s, 1] = 0, 0, b[1] * w1, 0, w1 * ddT[2] / dT[2] / dT[2]
        for j in range(2, s + 1):
            mu, tilde = 2 * b[j] * w0 / b[j - 1], 2 * b[j] * w1 / b[j - 1]
            table[s, j] = mu, -b[j] / b[j - 2], tilde, -(1 - b[j - 1] * T[j - 1]) * tilde, w1 * ddT[j] / dT[j]
    table.setflags(write=False)
    return table


FILM_SOURCE = """\
/* Written by gbid: gas film of the virtual rig, its rates and a Runge-Kutta-Chebyshev step. */
#include <math.h>
#include <string.h>
enum {CLEARANCE, FLOOR, PER_MASS, GRAVITY, SUPPLY, AMBIENT, DX, DZ, K24, FLOW, OPENING, CX, CY, REST, TABLES = 17};

/* Flow of a nozzle over its reference flow, by the ratio of the pressures; straight above 0.995 */
static double nozzle(double ratio) {
  const double g = 1.4, critical = pow(2/(g + 1), g/(g - 1)), straight = 0.995;
  double r = ratio < critical ? critical : ratio > straight ? straight : ratio;
  double flow = sqrt(2*g/(g - 1)*(pow(r, 2/g) - pow(r, (g + 1)/g)));
  return ratio > straight ? flow*(1 - ratio)/(1 - straight) : flow;
}

static void film_rates(const long *restrict G, const double *restrict F, const double *restrict x,
    const double *restrict y, const double *restrict ext, double speed, double *restrict d) {
  const long nt = G[0], nz = G[1], links = G[2];
  const double *cn = F + TABLES, *sn = cn + nt, *cf = sn + nt, *sf = cf + nt, *pocket = sf + nt;
  const double *part = pocket + nt*nz, *feed = part + links, *w = x + 4;
  const double X = x[0] + F[CX], Y = x[1] + F[CY], pa = F[AMBIENT], pa2 = pa*pa;
  double h[nt], a[nt], b[nt], g[nt], p[nt*nz], p2[nt*nz], q[nt], below[nt], fx = 0, fy = 0, mouth[4] = {0, 0, 0, 0};
  for (long i = 0; i < nt; i++) {
    double at = F[CLEARANCE] - X*cn[i] - Y*sn[i], face = F[CLEARANCE] - X*cf[i] - Y*sf[i];
    h[i] = at < F[FLOOR] ? F[FLOOR] : at;
    face = face < F[FLOOR] ? F[FLOOR] : face;
    a[i] = face*face*face*F[K24]/(F[DX]*F[DX]);
    b[i] = speed*face/(4*F[DX]);
    g[i] = h[i]*h[i]*h[i]*F[K24]/(F[DZ]*F[DZ]);
    below[i] = 0;
  }
  for (long j = 0; j < nz; j++)
    for (long i = 0; i < nt; i++) {
      p[j*nt + i] = w[j*nt + i]/(h[i] + pocket[j*nt + i]);
      p2[j*nt + i] = p[j*nt + i]*p[j*nt + i];
    }
  for (long j = 0; j < nz; j++) {
    const double *restrict s = p2 + j*nt, *restrict r = p + j*nt, area = F[DX]*F[DZ]*(j ? 1 : 0.5);
    double *restrict out = d + 4 + j*nt, ax = 0, ay = 0;
    for (long i = 0; i < nt - 1; i++) q[i] = a[i]*(s[i + 1] - s[i]) - b[i]*(r[i] + r[i + 1]);
    q[nt - 1] = a[nt - 1]*(s[0] - s[nt - 1]) - b[nt - 1]*(r[nt - 1] + r[0]);
    out[0] = q[0] - q[nt - 1];
    for (long i = 1; i < nt; i++) out[i] = q[i] - q[i - 1];
    for (long i = 0; i < nt; i++) {
      double above = g[i]*((j + 1 < nz ? s[nt + i] : pa2) - s[i]);
      out[i] += j ? above - below[i] : 2*above;
      below[i] = above;
      ax += (r[i] - pa)*cn[i];
      ay += (r[i] - pa)*sn[i];
    }
    fx -= 2*area*ax;
    fy -= 2*area*ay;
  }
  for (long k = 0; k < links; k++) mouth[G[3 + 2*k]] += part[k]*p[G[4 + 2*k]];
  for (int m = 0; m < 4; m++) {
    double open = F[OPENING] - (y[m] - F[REST + m]);
    mouth[m] = F[FLOW]*(open > 0 ? open : 0)*nozzle(mouth[m]/F[SUPPLY]);
  }
  for (long k = 0; k < links; k++) d[4 + G[4 + 2*k]] += feed[k]*mouth[G[3 + 2*k]];
  d[0] = x[2];
  d[1] = x[3];
  d[2] = fx*F[PER_MASS] + ext[0];
  d[3] = fy*F[PER_MASS] - F[GRAVITY] + ext[1];
}

void gbid_film_rates(const long *G, const double *F, const double *x, const double *y, const double *ext, double speed,
    double *d) { film_rates(G, F, x, y, ext, speed, d); }

/* stacks: positions at the start and the end of the step, 8; ext: forces at start, middle and end, 6;
   wall: stiffness and damping per mass beyond the clearance, or 0 */
static void film_step(const long *restrict G, const double *restrict F, const double *restrict table, long widest,
    double h, const double *stacks, const double *ext, double speed, const double *wall, double *restrict x) {
  const long n = 4 + G[0]*G[1];
  const double *pocket = F + TABLES + 4*G[0];
  double high = 0;  /* the largest p h^2 bounds the rates of the film */
  double buffers[4][n], f0[n], f[n], *before = buffers[0], *last = buffers[1], *next = buffers[2];
  for (long i = 0; i < G[0]; i++) {
    double gap = F[CLEARANCE] - (x[0] + F[CX])*F[TABLES + i] - (x[1] + F[CY])*F[TABLES + G[0] + i];
    gap = gap < F[FLOOR] ? F[FLOOR] : gap;
    for (long j = 0; j < G[1]; j++) {
      double v = x[4 + j*G[0] + i]/(gap + pocket[j*G[0] + i])*gap*gap;
      high = v > high ? v : high;
    }
  }
  double reach = 1.2*h*8*F[K24]*high*(1/(F[DX]*F[DX]) + 1/(F[DZ]*F[DZ]));
  long s = 2 + (long)sqrt(1 + 1.54*reach);
  s = s > widest ? widest : s;
  const double *c = table + 5*s*(widest + 1);
  double y[4], e[2], at = 0;
  memcpy(before, x, sizeof f);
  for (long j = 1; j <= s; j++) {
    for (int i = 0; i < 4; i++) y[i] = (1 - at)*stacks[i] + at*stacks[4 + i];
    for (int i = 0; i < 2; i++)
      e[i] = at < 0.5 ? (1 - 2*at)*ext[i] + 2*at*ext[2 + i] : (2 - 2*at)*ext[2 + i] + (2*at - 1)*ext[4 + i];
    const double *now = j == 1 ? x : last;
    double px = now[0] + F[CX], py = now[1] + F[CY], radius = sqrt(px*px + py*py);
    if (wall && radius > F[CLEARANCE]) {
      double push = wall[0]*(radius - F[CLEARANCE]) + wall[1]*(px*now[2] + py*now[3])/radius;
      push = push < 0 ? 0 : push;
      e[0] -= push*px/radius;
      e[1] -= push*py/radius;
    }
    film_rates(G, F, now, y, e, speed, j == 1 ? f0 : f);
    const double mu = c[5*j], nu = c[5*j + 1], tilde = h*c[5*j + 2], gamma = h*c[5*j + 3];
    if (j == 1) for (long i = 0; i < n; i++) last[i] = x[i] + tilde*f0[i];
    else {
      for (long i = 0; i < n; i++)
        next[i] = (1 - mu - nu)*x[i] + mu*last[i] + nu*before[i] + tilde*f[i] + gamma*f0[i];
      double *old = before; before = last; last = next; next = old;
    }
    at = c[5*j + 4];
  }
  memcpy(x, last, sizeof f);
}
"""
"""C source of the film, which the time stepping of the rig contains."""
