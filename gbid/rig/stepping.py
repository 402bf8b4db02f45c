"""Motion of the rig by time stepping in C: nonlinear machines, control loops, changing pressure and speed."""

from __future__ import annotations

import ctypes
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import numpy as np
import scipy

from gbid.core.arrays import FloatArray
from gbid.core.brief import Brief
from gbid.core.compiled import CompilerMissingError, load_library
from gbid.core.errors import UsageError
from gbid.rig.excitation import Course, StackStaircase
from gbid.rig.film import FILM_SOURCE, MAX_STAGES, chebyshev_table, equilibrium
from gbid.rig.machine import ActuatorTruth, Machine, RotorBearingTruth
from gbid.rig.piezo import ALLOCATION, N_PLAYS, PiezoStacks, pair_difference
from gbid.rig.response import MIN_OVERSAMPLING, Forces
from gbid.rig.sensors import LoopProgram, SampledController

STEP, DELAY, BEARING = 21, slice(19, 21), slice(0, 12)
"""Indices of the step size, of the delays (in steps), and of K, D and B in `StepArrays.rotor`."""


class _Row(NamedTuple):
    r: slice = slice(0, 2)
    u: slice = slice(2, 4)
    p: slice = slice(4, 6)
    seen: slice = slice(6, 8)
    stacks: slice = slice(8, 12)
    volts: slice = slice(12, 16)
    ended: slice = slice(16, 20)
    radius: int = 20
    commands: slice = slice(21, 25)


ROW = _Row()
"""Columns of the result: r, u, p, p as the sensor shows it, stack positions and voltages, share of the sample
during which each stack was saturated, largest radius within the sample, command of each stack."""
ROW_WIDTH = 25


class StackArrays(NamedTuple):
    """Constants of the four stacks: (4,) arrays, `thresholds` (N_PLAYS, 4), `creep` and `relax` (n_creep, 4)."""

    gain: FloatArray
    lead: FloatArray
    pole: FloatArray
    slow: FloatArray
    fast: FloatArray
    spring: FloatArray
    play: FloatArray
    stroke: FloatArray
    voltage_limit: FloatArray
    reference_gain: FloatArray
    open_loop: FloatArray
    share_x: FloatArray
    share_y: FloatArray
    thresholds: FloatArray
    creep: FloatArray
    relax: FloatArray


class Chunk(NamedTuple):
    """Inputs of the time stepping for a chunk of n samples.

    Attributes
    ----------
    excitation : (n, 2) array
        References without the part of the controller [m].
    base : (n, 4) array
        Command of each stack without the references of the pairs: r_0 [m], or volts for a stack in open loop.
    forces : (2 n oversampling + 1, 2) array
        Forces per moving mass at the time steps and half-way between [m/s^2].
    sensor : (n, 2) array
        Run-out, offset and noise of the probes [m].
    taken : (n, 2) array
        Correction that the controller subtracts from the measured position [m].
    speed : (n,) array
        Speed of the shaft [rad/s]; only a gas film needs it.
    """

    excitation: FloatArray
    base: FloatArray
    forces: FloatArray
    sensor: FloatArray
    taken: FloatArray
    speed: FloatArray


@dataclass(frozen=True, eq=False)
class StepArrays:
    """Constants of a simulation by time stepping, as plain arrays.

    Attributes
    ----------
    rotor : (22,) array
        K, D, B row by row, 1/l^2, clearance, wall stiffness and damping per mass, omega^2, 2 zeta omega and share
        of the flexible mode, delays in steps, step [s].
    linear : (2, 6) array
        Exact step of a linear actuator: a' = m0 a + m1 r, u' = m2 a + m3 u + m4 r.
    stacks : StackArrays or None
        Constants of the stacks; None for linear actuators.
    controller : SampledController or None
        Controller of the loop; None in open loop.
    oversampling : int
        Time steps per sample.
    wall : bool
        Whether the disc touches a wall at the clearance.
    resolution, travel : float
        Resolution of p [m], 0 for none, and limit of r in a control loop [m].
    grid, film : array
        Integers and numbers of `gbid.rig.film.FilmPoint.arrays`; empty without a gas film.
    radius : float
        Radius of the shaft in the film [m].
    """

    rotor: FloatArray
    linear: FloatArray
    stacks: StackArrays | None
    controller: SampledController | None
    oversampling: int
    wall: bool
    resolution: float
    travel: float
    grid: np.ndarray
    film: FloatArray
    radius: float


@dataclass(frozen=True, eq=False)
class StepState:
    """State of a simulation between chunks; its arrays are changed in place.

    Attributes
    ----------
    rotor : (8,) array
        q [m], its velocity [m/s], eta of the flexible mode [m], its velocity [m/s].
    linear : (2,) array
        Slow state of each linear actuator [m].
    stack : (3, 4) array
        PD state, amplifier voltage [V] and position [m] of each stack.
    plays, creep : (N_PLAYS, 4), (n_creep, 4) array
        States of the plays [V] and of the creep [m].
    controller, command : (n,), (2,) array
        State and last output [m] of the controller.
    history : (kept + 1, 2) array
        u at the last time steps [m], the present one in the last row.
    gas : (4 + n_cells,) array
        State of a gas film, see `gbid.rig.film.FilmPoint.rates`, whose first four entries are those of `rotor`; empty
        without one.
    """

    rotor: FloatArray
    linear: FloatArray
    stack: FloatArray
    plays: FloatArray
    creep: FloatArray
    controller: FloatArray
    command: FloatArray
    history: FloatArray
    gas: FloatArray


def step_arrays(
    machine: Machine,
    controller: SampledController | None,
    sample_time: float,
    oversampling: int,
    wall: bool,
    open_loop: int | None = None,
) -> StepArrays:
    """Return the constants of a simulation.

    Parameters
    ----------
    machine : Machine
        The machine.
    controller : SampledController or None
        Controller of the loop.
    sample_time : float
        Time between samples [s].
    oversampling : int
        Time steps per sample.
    wall : bool
        Whether the disc touches a wall at the clearance.
    open_loop : int, optional
        Number of the stack whose controller is off.

    Raises
    ------
    UsageError
        When the time step is too long for the fastest pole.
    """
    h = sample_time / oversampling
    rb, mass = machine.rotor_bearing, machine.moving_mass
    flexible, contact = machine.flexible_mode, machine.contact
    omega = 2 * np.pi * flexible.frequency_hz if flexible else 1.0
    rotor = np.concatenate(
        [
            *(matrix.ravel() for matrix in (rb.stiffness, rb.damping, rb.input_gain)),
            [machine.stiffening.inverse_square_length if machine.stiffening else 0.0, machine.clearance],
            [contact.stiffness / mass, contact.damping / mass],
            [omega**2, 2 * flexible.damping * omega if flexible else 2.0, flexible.share if flexible else 0.0],
            rb.delay / h if machine.film is None else np.zeros(2),
            [h],
        ]
    )
    actuator = machine.actuator
    stacks = _stack_arrays(actuator, h, open_loop) if isinstance(actuator, PiezoStacks) else None
    linear = _linear_steps(actuator, h) if isinstance(actuator, ActuatorTruth) else np.zeros((2, 6))
    fastest = max(omega, np.sqrt(contact.stiffness / mass) if wall else 0.0)
    if stacks is not None:
        fastest = max(fastest, float((stacks.fast + stacks.slow).max()))
    if fastest * h > 0.5:
        raise UsageError(
            f"a step of {h:.3g} s is too long for a pole of {fastest:.4g} rad/s; raise oversampling to at least "
            f"{int(np.ceil(2 * fastest * sample_time))}"
        )
    grid, numbers, radius = np.zeros(1, ctypes.c_long), np.zeros(0), 0.0
    if machine.film is not None:
        rest = [0.0] * 4
        if isinstance(actuator, PiezoStacks):
            rest = [stack.rest(actuator.offset).position for stack in actuator.stacks]
        grid, numbers = machine.film.arrays(equilibrium(machine.film)[:2], np.array(rest))
        radius = machine.film.film.radius
    resolution = machine.sensors.resolution_p_m
    return StepArrays(
        rotor, linear, stacks, controller, oversampling, wall, resolution, machine.travel, grid, numbers, radius
    )


def rest_state(arrays: StepArrays, machine: Machine, base: FloatArray, delay: float) -> StepState:
    """Return the state of rest under the first commands of the stacks `base`, shape (4,) [m or V].

    The history of u reaches back over `delay`, the longest delay of the run [steps].
    """
    n_controller = 0 if arrays.controller is None else len(arrays.controller.A)
    stack, plays = np.zeros((3, 4)), np.zeros((N_PLAYS, 4))
    n_creep = 0 if arrays.stacks is None else len(arrays.stacks.creep)
    creep, u = np.zeros((n_creep, 4)), np.zeros(2)
    if arrays.stacks is not None and isinstance(machine.actuator, PiezoStacks):
        for i, piezo in enumerate(machine.actuator.stacks):
            command = float(base[i])
            rest = piezo.rest(0.0, voltage=command) if arrays.stacks.open_loop[i] else piezo.rest(command)
            error = piezo.reference_gain * float(base[i]) - rest.position
            stack[:, i] = (piezo.pd_zero - piezo.pd_pole) / piezo.pd_pole * error, rest.voltage, rest.position
            plays[:, i] = rest.plays
            creep[:, i] = arrays.stacks.creep[:, i] * rest.expansion
        u = pair_difference(stack[2])
    rotor, gas = np.zeros(8), np.zeros(0)
    if machine.film is None:
        rotor[0:2] = -np.linalg.solve(machine.rotor_bearing.stiffness, machine.rotor_bearing.input_gain @ u)
    else:
        gas = equilibrium(machine.film).copy()
    kept = int(np.ceil(delay)) + 1
    return StepState(
        rotor, np.zeros(2), stack, plays, creep, np.zeros(n_controller), np.zeros(2), np.tile(u, (kept + 1, 1)), gas
    )


def _stack_arrays(actuator: PiezoStacks, h: float, open_loop: int | None) -> StackArrays:
    def each(value: str) -> FloatArray:
        return np.array([float(getattr(stack, value)) for stack in actuator.stacks])

    opened = np.array([float(number == open_loop) for number in (1, 2, 3, 4)])
    times = np.array([stack.creep_times for stack in actuator.stacks]).T
    return StackArrays(
        each("pd_gain") * each("pd_scale"),
        each("pd_zero") - each("pd_pole"),
        each("pd_pole"),
        each("slow_pole"),
        each("fast_pole"),
        each("spring"),
        each("play_weight"),
        each("stroke"),
        each("voltage_limit"),
        each("reference_gain"),
        opened,
        ALLOCATION[:, 0] * (1 - opened),
        ALLOCATION[:, 1] * (1 - opened),
        np.column_stack([stack.thresholds for stack in actuator.stacks]),
        np.tile(each("creep") / max(len(times), 1), (len(times), 1)),
        -np.expm1(-h / times) if len(times) else np.zeros((0, 4)),
    )


def _linear_steps(actuator: ActuatorTruth, h: float) -> FloatArray:
    rows = np.zeros((2, 6))
    for j, (slow, fast, gain) in enumerate(zip(actuator.slow_pole, actuator.fast_pole, actuator.gain, strict=True)):
        step = scipy.linalg.expm(h * np.array([[-slow, 0, slow * gain], [fast, -fast, 0], [0, 0, 0]]))
        rows[j, :5] = step[0, 0], step[0, 2], step[1, 0], step[1, 1], step[1, 2]
    return rows


SOURCE = (
    FILM_SOURCE
    + """\
/* Written by gbid: actuators, delays, rotor and controller of the virtual rig, one fine step after another.
   Classical Runge-Kutta of fourth order; plays move at the end of each step. */
#include <math.h>
#define PLAYS 10
enum {P_, ZP, PP, WS, WF, SPRING, PLAY, STROKE, VMAX, GREF, OPEN, SX, SY, FIELDS};

typedef struct {double q[4], a[4], y[4];} stack_state;

static inline void stack_rates(const double (*restrict st)[4], const double (*restrict rho)[4],
    const double (*restrict play)[4], const double *restrict crept, const double *restrict cmd,
    const stack_state *restrict x, stack_state *restrict d, double *restrict volts) {
  double h[4];
  for (int i = 0; i < 4; i++) h[i] = 0;
  for (int j = 0; j < PLAYS; j++)
    for (int i = 0; i < 4; i++) {
      double top = x->a[i] < play[j][i] ? x->a[i] : play[j][i];
      double low = x->a[i] - rho[j][i];
      h[i] += low > top ? low : top;
    }
  for (int i = 0; i < 4; i++) {
    double e = st[GREF][i]*cmd[i] - x->y[i];
    double v = st[P_][i]*(x->q[i] + e);
    v = st[OPEN][i] != 0 ? cmd[i] : v;
    v = v < 0 ? 0 : v;
    v = v > st[VMAX][i] ? st[VMAX][i] : v;
    double goal = st[SPRING][i]*x->a[i] + st[PLAY][i]*h[i] + crept[i];
    goal = goal < 0 ? 0 : goal;
    goal = goal > st[STROKE][i] ? st[STROKE][i] : goal;
    volts[i] = v;
    d->q[i] = st[ZP][i]*e - st[PP][i]*x->q[i];
    d->a[i] = st[WS][i]*(v - x->a[i]);
    d->y[i] = st[WF][i]*(goal - x->y[i]);
  }
}

static inline void along(const stack_state *restrict x, double h, const stack_state *restrict d,
    stack_state *restrict out) {
  for (int i = 0; i < 4; i++) {
    out->q[i] = x->q[i] + h*d->q[i];
    out->a[i] = x->a[i] + h*d->a[i];
    out->y[i] = x->y[i] + h*d->y[i];
  }
}

enum {K = 0, DD = 4, B = 8, CUBIC = 12, CLEAR, WALL, WALLD, FW2, F2ZW, SHARE, LATE_X, LATE_Y, STEP};

static inline void rotor_rates(const double *restrict R, const double *restrict x, const double *restrict u,
    const double *restrict ext, int wall, double *restrict d) {
  double px = x[0] + x[4], py = x[1] + x[5], vx = x[2] + x[6], vy = x[3] + x[7];
  double fx = R[B]*u[0] + R[B+1]*u[1] + ext[0], fy = R[B+2]*u[0] + R[B+3]*u[1] + ext[1];
  double rr = px*px + py*py;
  if (wall && rr > R[CLEAR]*R[CLEAR]) {
    double radius = sqrt(rr), nx = px/radius, ny = py/radius;
    double push = R[WALL]*(radius - R[CLEAR]) + R[WALLD]*(nx*vx + ny*vy);
    push = push < 0 ? 0 : push;
    fx -= push*nx; fy -= push*ny;
  }
  double stiff = 1 + R[CUBIC]*(x[0]*x[0] + x[1]*x[1]), sx = stiff*x[0], sy = stiff*x[1];
  d[0] = x[2]; d[1] = x[3];
  d[2] = R[K]*sx + R[K+1]*sy + R[DD]*x[2] + R[DD+1]*x[3] + fx;
  d[3] = R[K+2]*sx + R[K+3]*sy + R[DD+2]*x[2] + R[DD+3]*x[3] + fy;
  d[4] = x[6]; d[5] = x[7];
  d[6] = R[SHARE]*fx - R[FW2]*x[4] - R[F2ZW]*x[6];
  d[7] = R[SHARE]*fy - R[FW2]*x[5] - R[F2ZW]*x[7];
}

static inline double looked_up(const double *restrict hist, double at, int axis) {
  long i = (long)floor(at);
  double w = at - i;
  return (1 - w)*hist[2*i + axis] + w*hist[2*i + 2 + axis];
}

/* sizes: samples, steps a sample, stacks?, creep states, kept history, controller states, wall?
   out, a row a sample: r 2, u 2, p 2, measured 2, y 4, v 4, time at an end 4, largest radius 1 */
void gbid_rig_steps(const long *restrict sizes, const double *restrict R, const double *restrict lin,
    const double (*restrict st)[4], const double (*restrict rho)[4], const double (*restrict gain)[4],
    const double (*restrict relax)[4], const double *restrict excitation, const double *restrict base,
    const double *restrict ext, const double *restrict sensor, const double *restrict taken,
    const double *restrict ctrl, const double *restrict limits, double *restrict lin_x,
    stack_state *restrict x, double (*restrict play)[4], double (*restrict creep)[4], double *restrict rot,
    double *restrict ctrl_x, double *restrict hist, double *restrict out, const long *restrict grid,
    const double *restrict film, const double *restrict table, const double *restrict speed, double *restrict gas) {
  const long n = sizes[0], over = sizes[1], kept = sizes[4], nc = sizes[5];
  const int filmed = grid[0] != 0;
  const double ox = filmed ? film[CX] : 0, oy = filmed ? film[CY] : 0;
  const int stacks = sizes[2] != 0, wall = sizes[6] != 0, in_loop = nc >= 0;
  const int creeps = (int)sizes[3];
  const double h = R[STEP], resolution = limits[0], travel = limits[1];
  double *w = ctrl_x + (in_loop ? nc : 0), crept[4] = {0, 0, 0, 0};
  if (stacks) for (int k = 0; k < creeps; k++) for (int i = 0; i < 4; i++) crept[i] += creep[k][i];
  for (long k = 0; k < n; k++) {
    double *row = out + 25*k, r[2], cmd[4] = {0, 0, 0, 0}, v[4] = {0, 0, 0, 0}, ended[4] = {0, 0, 0, 0};
    for (int j = 0; j < 2; j++) {
      r[j] = excitation[2*k + j];
      if (in_loop) {
        r[j] += w[j];
        r[j] = r[j] > travel ? travel : r[j] < -travel ? -travel : r[j];
      }
    }
    double disc[2] = {rot[0] + rot[4], rot[1] + rot[5]}, seen[2];
    double worst = (disc[0] + ox)*(disc[0] + ox) + (disc[1] + oy)*(disc[1] + oy);
    for (int j = 0; j < 2; j++) {
      seen[j] = disc[j] + sensor[2*k + j];
      if (resolution > 0) seen[j] = rint(seen[j]/resolution)*resolution;
    }
    if (in_loop) {
      double e[2] = {seen[0] - taken[2*k], seen[1] - taken[2*k + 1]}, next[nc + 1];
      const double *A = ctrl, *Bc = A + nc*nc, *C = Bc + 2*nc, *D = C + 2*nc;
      for (int j = 0; j < 2; j++) {
        double s = D[2*j]*e[0] + D[2*j + 1]*e[1];
        for (long i = 0; i < nc; i++) s += C[j*nc + i]*ctrl_x[i];
        w[j] = s;
      }
      for (long i = 0; i < nc; i++) {
        double s = Bc[2*i]*e[0] + Bc[2*i + 1]*e[1];
        for (long m = 0; m < nc; m++) s += A[i*nc + m]*ctrl_x[m];
        next[i] = s;
      }
      for (long i = 0; i < nc; i++) ctrl_x[i] = next[i];
    }
    for (int j = 0; j < 2; j++) {
      row[j] = r[j]; row[2 + j] = hist[2*(kept + k*over) + j];
      row[4 + j] = disc[j]; row[6 + j] = seen[j];
    }
    if (stacks)
      for (int i = 0; i < 4; i++) {
        cmd[i] = base[4*k + i] + st[SX][i]*r[0] + st[SY][i]*r[1];
        row[8 + i] = x->y[i];
      }
    for (long f = 0; f < over; f++) {
      const long t = k*over + f;
      double *now = hist + 2*(kept + t + 1), pins[8];
      for (int i = 0; i < 4; i++) pins[i] = stacks ? x->y[i] : (i < 2 ? 0.5 : -0.5)*now[-1 - i % 2];
      if (stacks) {
        stack_state d1, d2, d3, d4, s;
        double v1[4];
        stack_rates(st, rho, (const double (*)[4])play, crept, cmd, x, &d1, f == 0 ? v : v1);
        if (f == 0) for (int i = 0; i < 4; i++) v1[i] = v[i];
        for (int i = 0; i < 4; i++) {
          double wanted = st[P_][i]*(x->q[i] + st[GREF][i]*cmd[i] - x->y[i]);
          ended[i] += (st[OPEN][i] == 0 && (wanted < 0 || wanted > st[VMAX][i])) || x->y[i] > st[STROKE][i]*(1 - 1e-6);
        }
        double vs[4];
        along(x, h/2, &d1, &s); stack_rates(st, rho, (const double (*)[4])play, crept, cmd, &s, &d2, vs);
        along(x, h/2, &d2, &s); stack_rates(st, rho, (const double (*)[4])play, crept, cmd, &s, &d3, vs);
        along(x, h, &d3, &s);   stack_rates(st, rho, (const double (*)[4])play, crept, cmd, &s, &d4, vs);
        double hys[4];
        for (int i = 0; i < 4; i++) {
          x->q[i] += h/6*(d1.q[i] + 2*d2.q[i] + 2*d3.q[i] + d4.q[i]);
          x->a[i] += h/6*(d1.a[i] + 2*d2.a[i] + 2*d3.a[i] + d4.a[i]);
          x->y[i] += h/6*(d1.y[i] + 2*d2.y[i] + 2*d3.y[i] + d4.y[i]);
          hys[i] = 0; crept[i] = 0;
        }
        for (int j = 0; j < PLAYS; j++)
          for (int i = 0; i < 4; i++) {
            double top = x->a[i] < play[j][i] ? x->a[i] : play[j][i], low = x->a[i] - rho[j][i];
            play[j][i] = low > top ? low : top;
            hys[i] += play[j][i];
          }
        for (int i = 0; i < 4; i++) hys[i] = st[SPRING][i]*x->a[i] + st[PLAY][i]*hys[i];
        for (int c = 0; c < creeps; c++)
          for (int i = 0; i < 4; i++) {
            creep[c][i] += relax[c][i]*(gain[c][i]*hys[i] - creep[c][i]);
            crept[i] += creep[c][i];
          }
        now[0] = x->y[1] - x->y[3];
        now[1] = x->y[0] - x->y[2];
      } else
        for (int j = 0; j < 2; j++) {
          const double *l = lin + 6*j;
          double a = lin_x[j], u = now[j - 2];
          now[j] = l[2]*a + l[3]*u + l[4]*r[j];
          lin_x[j] = l[0]*a + l[1]*r[j];
        }
      if (filmed) {
        for (int i = 0; i < 4; i++) pins[4 + i] = stacks ? x->y[i] : (i < 2 ? 0.5 : -0.5)*now[1 - i % 2];
        memcpy(gas, rot, 4*sizeof *gas);
        film_step(grid, film, table, WIDEST, h, pins, ext + 4*t, speed[k], wall ? R + WALL : 0, gas);
        memcpy(rot, gas, 4*sizeof *gas);
      } else {
        double u0[2], u1[2], u2[2], d1[8], d2[8], d3[8], d4[8], s[8];
        for (int j = 0; j < 2; j++) {
          double at = kept + t - R[LATE_X + j];
          u0[j] = looked_up(hist, at, j); u1[j] = looked_up(hist, at + 0.5, j); u2[j] = looked_up(hist, at + 1, j);
        }
        const double *g = ext + 4*t;
        rotor_rates(R, rot, u0, g, wall, d1);
        for (int i = 0; i < 8; i++) s[i] = rot[i] + h/2*d1[i];
        rotor_rates(R, s, u1, g + 2, wall, d2);
        for (int i = 0; i < 8; i++) s[i] = rot[i] + h/2*d2[i];
        rotor_rates(R, s, u1, g + 2, wall, d3);
        for (int i = 0; i < 8; i++) s[i] = rot[i] + h*d3[i];
        rotor_rates(R, s, u2, g + 4, wall, d4);
        for (int i = 0; i < 8; i++) rot[i] += h/6*(d1[i] + 2*d2[i] + 2*d3[i] + d4[i]);
      }
      double px = rot[0] + rot[4] + ox, py = rot[1] + rot[5] + oy, radius = px*px + py*py;
      worst = radius > worst ? radius : worst;
    }
    for (int i = 0; i < 4; i++) { row[12 + i] = v[i]; row[16 + i] = ended[i]/over; }
    row[20] = sqrt(worst);
    for (int i = 0; i < 4; i++) row[21 + i] = cmd[i];
  }
  for (long i = 0; i < 2*(kept + 1); i++) hist[i] = hist[2*n*over + i];
}
""".replace("WIDEST", str(MAX_STAGES))
)


@dataclass(frozen=True, eq=False)
class ProgramLoop:
    """Control program with the angle, speed and pressure that it measures at each sample.

    Attributes
    ----------
    program : LoopProgram
        The program.
    angle, speed_rpm : (n,) array
        Shaft angle that the encoder shows [rad], and speed [rpm], for each sample.
    pressure_bar : (n,) array
        Pressure for each sample [bar].
    """

    program: LoopProgram
    angle: FloatArray
    speed_rpm: FloatArray
    pressure_bar: FloatArray

    def part(self, rows: slice) -> ProgramLoop:
        """Return the loop restricted to a range of samples."""
        return ProgramLoop(self.program, self.angle[rows], self.speed_rpm[rows], self.pressure_bar[rows])


def run_with_program(arrays: StepArrays, state: StepState, chunk: Chunk, loop: ProgramLoop) -> FloatArray:
    """Return the motion over a chunk of samples with a program in the loop.

    Parameters
    ----------
    arrays, state, chunk
        Constants and state of the time stepping, and the inputs of the samples of `loop`.
    loop : ProgramLoop
        The program, with angle and speed of these samples.

    Returns
    -------
    (n_samples, ROW_WIDTH) array
        Columns as in `gbid.rig.stepping.ROW`.
    """
    n, steps = len(chunk.excitation), 2 * arrays.oversampling
    rows = np.empty((n, ROW_WIDTH))
    for k in range(n):
        r = np.clip(chunk.excitation[k] + state.command, -arrays.travel, arrays.travel)
        sample = Chunk(
            r[None],
            chunk.base[k : k + 1],
            chunk.forces[k * steps : (k + 1) * steps + 1],
            chunk.sensor[k : k + 1],
            chunk.taken[k : k + 1],
            chunk.speed[k : k + 1],
        )
        rows[k] = run_steps(arrays, state, sample)[0]
        seen = rows[k, ROW.seen]
        state.command[:] = loop.program.references(seen, loop.angle[k], loop.pressure_bar[k], loop.speed_rpm[k])
    return rows


Surfaces = Callable[[FloatArray, FloatArray], Mapping[str, Any]]
"""True key parameters by name for arrays of pressures [bar] and speeds [rpm], as `gbid.LPVModel.key_parameters`."""

PIECE = 10
"""Samples with constant parameters of rotor and bearing, those in the middle."""


def truths_along(
    surfaces: Surfaces, course: Course, times: FloatArray, deviation: Mapping[str, float] | None = None
) -> tuple[RotorBearingTruth, ...]:
    """Return the parameters of rotor and bearing at the middle of each piece of `PIECE` samples of a run.

    Parameters
    ----------
    surfaces : callable
        True surfaces.
    course : Course
        Pressure and speed.
    times : (n,) array
        Times of the samples [s].
    deviation : dict of str to float, optional
        Deviation of this recording from the surfaces.

    Raises
    ------
    UsageError
        When the rotor is unstable or a delay is negative on the way.
    """
    step = times[1] - times[0]
    middles = np.array([times[i : i + PIECE].mean() + step / 2 for i in range(0, len(times), PIECE)])
    values = surfaces(*course.at(middles))
    columns = {k: np.broadcast_to(np.asarray(v, float), middles.shape) for k, v in values.items()}
    columns = {k: column + (deviation or {}).get(k, 0.0) for k, column in columns.items()}
    truths = tuple(
        RotorBearingTruth.from_parameters({k: column[i] for k, column in columns.items()}) for i in range(len(middles))
    )
    for truth in truths[:: max(1, len(truths) // 200)]:
        truth.check_stable()
    return truths


def _at(arrays: StepArrays, truth: RotorBearingTruth) -> StepArrays:
    """Return the constants of the simulation with new parameters of rotor and bearing."""
    rotor = arrays.rotor.copy()
    matrices = (truth.stiffness, truth.damping, truth.input_gain)
    rotor[BEARING] = np.concatenate([matrix.ravel() for matrix in matrices])
    rotor[DELAY] = truth.delay / rotor[STEP]
    return replace(arrays, rotor=rotor)


_CHUNK = 2000
"""Samples per chunk: the forces on the fine grid then fit into the processor cache."""


@dataclass(frozen=True, eq=False)
class SteppedMotion(Brief):
    """Result of the time stepping, one row per sample.

    Attributes
    ----------
    r, u, p : (n, 2) array
        References as applied, differences of stack positions, disc position [m].
    seen : (n, 2) array
        Disc position as the probes show it [m].
    stacks, volts, commands : (n, 4) array
        Positions [m], voltages [V] and commands of the stacks (reference [m], or volts in open loop); zero for linear
        actuators.
    ended : (n, 4) array
        Share of each sample during which the voltage or the expansion of a stack was at its limit.
    radius : (n,) array
        Largest distance of the disc from the centre within each sample [m].
    how : str
        How it was computed: in closed form or by stepping.
    """

    r: FloatArray
    u: FloatArray
    p: FloatArray
    seen: FloatArray
    stacks: FloatArray
    volts: FloatArray
    commands: FloatArray
    ended: FloatArray
    radius: FloatArray
    how: str


def stepped_motion(
    machine: Machine,
    excitation: FloatArray,
    forces: Forces,
    sensor: FloatArray,
    sample_time: float,
    *,
    controller: SampledController | None = None,
    taken: FloatArray | None = None,
    program: ProgramLoop | None = None,
    stack_run: StackStaircase | None = None,
    along: Sequence[RotorBearingTruth] = (),
    n_settle: int = 0,
    oversampling: int = MIN_OVERSAMPLING,
    wall: bool = True,
) -> SteppedMotion:
    """Return the motion computed by classical Runge-Kutta steps of sample_time/oversampling.

    References are held over each sample. The delayed u is interpolated linearly between steps. Unbalance and other
    forces are evaluated at the steps and half-way between. The stacks start at rest under r_0, the rotor starts on its
    unbalance orbit.

    Parameters
    ----------
    machine : Machine
        The machine.
    excitation : (n, 2) array
        r [m] without the part of the controller.
    forces : Forces
        Additional forces on the rotor.
    sensor : (n, 2) array
        Run-out, offset and noise that the probes add to the disc position [m].
    sample_time : float
        Time between samples [s].
    controller : SampledController, optional
        Controller of the loop; open loop when not given.
    taken : (n, 2) array, optional
        Correction that the controller subtracts from the measured position [m].
    program : ProgramLoop, optional
        Program that closes the loop in place of `controller`.
    along : sequence of RotorBearingTruth, optional
        Parameters of rotor and bearing in each piece of `PIECE` samples, in place of those of the machine.
    stack_run : StackStaircase, optional
        Staircase of one stack, which then does not follow the references of its pair.
    n_settle : int
        Number of samples before the logger starts.
    oversampling : int
        Time steps per sample, at least 20.
    wall : bool
        Whether a contact holds the disc at the clearance.

    Returns
    -------
    SteppedMotion

    Raises
    ------
    UsageError
        When there is no C compiler, when the time step is too long, or when a stack is
        commanded on a machine without stacks.
    """
    if oversampling < MIN_OVERSAMPLING:
        raise UsageError(f"oversampling = {oversampling}; give at least {MIN_OVERSAMPLING} steps in a sample")
    n = len(excitation)
    open_loop = None if stack_run is None or stack_run.controlled else stack_run.stack
    arrays = step_arrays(machine, controller, sample_time, oversampling, wall, open_loop)
    actuator, base = machine.actuator, np.zeros((n, 4))  # command of each stack without the references of the pairs
    if isinstance(actuator, PiezoStacks):
        base += actuator.offset
    if stack_run is not None:
        if not isinstance(actuator, PiezoStacks):
            raise UsageError("stack staircase: this machine has linear actuators; give it PiezoStacks")
        stack = actuator.stacks[stack_run.stack - 1]
        top = stack.stroke if stack_run.controlled else stack.voltage_limit
        base[:, stack_run.stack - 1] = stack_run.command(top, n, sample_time, n_settle)
    delays = [arrays.rotor[DELAY], *(truth.delay / arrays.rotor[STEP] for truth in along)]
    state = rest_state(arrays, machine, base[0] if n else np.zeros(4), float(np.max(delays)))
    orbit, velocity = forces.orbit_at_start()
    state.rotor[0:2] += orbit
    state.rotor[2:4] += velocity
    taken = np.zeros((n, 2)) if taken is None else taken
    rows = np.empty((n, ROW_WIDTH))
    speed = forces.turning.speed_at(np.asarray((np.arange(n) - n_settle) * sample_time, np.float64))
    for first in range(0, n, _CHUNK):
        last = min(first + _CHUNK, n)
        on_grid = forces.between(first, last, oversampling)
        for begin in range(first, last, PIECE if along else _CHUNK):
            part = slice(begin, min(begin + PIECE, last) if along else last)
            grid = slice(2 * oversampling * (part.start - first), 2 * oversampling * (part.stop - first) + 1)
            constants = _at(arrays, along[begin // PIECE]) if along else arrays
            chunk = Chunk(excitation[part], base[part], on_grid[grid], sensor[part], taken[part], speed[part])
            rows[part] = (
                run_steps(constants, state, chunk)
                if program is None
                else run_with_program(constants, state, chunk, program.part(part))
            )
    columns = (np.ascontiguousarray(rows[:, where]) for where in ROW)
    r, u, p, seen, stacks, volts, ended, radius, commands = columns
    return SteppedMotion(r, u, p, seen, stacks, volts, commands, ended, radius, "stepping, compiled")


def run_steps(arrays: StepArrays, state: StepState, chunk: Chunk) -> FloatArray:
    """Return the motion over a chunk of samples, computed in C; `state` is changed in place to the end of the chunk.

    Returns
    -------
    (n_samples, ROW_WIDTH) array
        Columns as in `ROW`.

    Raises
    ------
    UsageError
        When there is no C compiler.
    """
    try:
        step = load_library(SOURCE).gbid_rig_steps
    except CompilerMissingError as missing:
        raise UsageError(
            f"the rig steps through time in C: {missing}; install one (gcc, clang or gbid[compiler]), or "
            "record a linear machine in open loop, which has a closed form"
        ) from None
    n, kept = len(chunk.excitation), len(state.history) - 1
    stacks, controller = arrays.stacks, arrays.controller
    n_creep = len(state.creep)
    empty = np.zeros((max(n_creep, 1), 4))
    single = np.array(stacks[:13]) if stacks else np.zeros((13, 4))
    thresholds, creep, relax = stacks[13:] if stacks else (np.zeros_like(state.plays), empty, empty)
    blocks = [controller.A, controller.B, controller.C, controller.D] if controller else []
    loop = np.concatenate([block.ravel() for block in blocks]) if blocks else np.zeros(1)
    loop_state = np.concatenate([state.controller, state.command])
    history = np.vstack([state.history, np.zeros((n * arrays.oversampling + 1, 2))])
    n_loop = -1 if controller is None else len(controller.A)
    sizes = np.array(
        [n, arrays.oversampling, stacks is not None, n_creep, kept, n_loop, arrays.wall], dtype=ctypes.c_long
    )
    limits = np.array([arrays.resolution, arrays.travel])
    output = np.empty((n, ROW_WIDTH))
    constants = [arrays.rotor, arrays.linear, single, thresholds, creep, relax]
    drive = [chunk.excitation, chunk.base, chunk.forces, chunk.sensor, chunk.taken, loop, limits]
    moving = [state.linear, state.stack, state.plays, state.creep, state.rotor, loop_state, history, output]
    fixed = [np.ascontiguousarray(array, dtype=float) for array in constants + drive]
    filmed = [arrays.grid, arrays.film, chebyshev_table(), np.ascontiguousarray(arrays.radius * chunk.speed), state.gas]
    step.restype = None
    step(*(ctypes.c_void_p(array.ctypes.data) for array in (sizes, *fixed, *moving, *filmed)))
    state.controller[:], state.command[:] = loop_state[: len(state.controller)], loop_state[-2:]
    state.history[:] = history[: kept + 1]
    return output
