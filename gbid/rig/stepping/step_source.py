"""C source of the time stepping; `gbid.rig.stepping.python_twin` is the same in Python."""

from __future__ import annotations

SOURCE = """\
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
    double *restrict ctrl_x, double *restrict hist, double *restrict out) {
  const long n = sizes[0], over = sizes[1], kept = sizes[4], nc = sizes[5];
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
    double disc[2] = {rot[0] + rot[4], rot[1] + rot[5]}, seen[2], worst = disc[0]*disc[0] + disc[1]*disc[1];
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
      double *now = hist + 2*(kept + t + 1);
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
      double px = rot[0] + rot[4], py = rot[1] + rot[5], radius = px*px + py*py;
      worst = radius > worst ? radius : worst;
    }
    for (int i = 0; i < 4; i++) { row[12 + i] = v[i]; row[16 + i] = ended[i]/over; }
    row[20] = sqrt(worst);
    for (int i = 0; i < 4; i++) row[21 + i] = cmd[i];
  }
  for (long i = 0; i < 2*(kept + 1); i++) hist[i] = hist[2*n*over + i];
}
"""
