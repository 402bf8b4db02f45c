"""Compiled kernel of a linear predictor: C for one size and one pattern of nonzeros, and the passes that it runs."""

from __future__ import annotations

import ctypes
from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache
from importlib.resources import files
from typing import Any

import numpy as np
import numpy.typing as npt

from gbid.core.arrays import BoolArray, FloatArray, IntArray
from gbid.core.compiled import load_library
from gbid.identify.kernel.blocks import LANES, Blocks, BlockSums, Prediction, per_block
from gbid.identify.kernel.linear import Backwards, LinearKernel
from gbid.identify.kernel.sums import Linked
from gbid.identify.predictor import PredictorValues

# ---- Entries of the predictor's matrices that may differ from zero.


@dataclass(frozen=True, eq=False)
class KernelPattern:
    """Pattern of the entries of the predictor's matrices that may differ from zero; equal by content.

    Attributes
    ----------
    F : (n, n), G : (n, n_z), C : (n_y, n), H : (n_y, n_z) boolean arrays
        Patterns of the matrices.
    dF, dG, dC, dH : boolean arrays
        Patterns of the derivatives, with a first axis of parameters.
    """

    F: BoolArray
    G: BoolArray
    C: BoolArray
    H: BoolArray
    dF: BoolArray
    dG: BoolArray
    dC: BoolArray
    dH: BoolArray

    @classmethod
    def of(cls, v: PredictorValues) -> KernelPattern:
        """Return the entries that differ from zero at one parameter value."""
        return cls(*(array != 0 for array in v[:8]))

    def __eq__(self, other: object) -> bool:
        return isinstance(other, KernelPattern) and self._content() == other._content()

    def __hash__(self) -> int:
        return hash(self._content())

    def _content(self) -> tuple[tuple[tuple[int, ...], bytes], ...]:
        return tuple((array.shape, array.tobytes()) for array in self.arrays())

    def covers(self, other: KernelPattern) -> bool:
        """Whether every entry of another pattern is one of this."""
        return all(not (theirs & ~mine).any() for mine, theirs in zip(self.arrays(), other.arrays(), strict=True))

    def union(self, other: KernelPattern) -> KernelPattern:
        """Entries of either."""
        return KernelPattern(*(mine | theirs for mine, theirs in zip(self.arrays(), other.arrays(), strict=True)))

    def arrays(self) -> tuple[BoolArray, ...]:
        """Return the patterns in order."""
        return (self.F, self.G, self.C, self.H, self.dF, self.dG, self.dC, self.dH)

    def live(self, i: int) -> BoolArray:
        """Return which states ever depend on a parameter if none does at the start, (n,)."""
        return reached(self.F, self.dF[i].any(axis=1) | self.dG[i].any(axis=1))


def reached(F: BoolArray, first: BoolArray) -> BoolArray:
    """Return the pattern of ``F^k first`` for all k: where a recursion that begins with `first` differs from zero."""
    for _ in F:  # a product of more than n factors has no other entries
        first = first | (F @ first)
    return first


# ---- C source of the pass over the samples, for one size and one pattern of nonzeros.
#
# Eight blocks run side by side in the lanes of a vector type. The recursion of states and sensitivities is
# written out entry by entry, zeros left out; the sums over the samples are small matrix products on a buffer of
# a few steps, so that their accumulators stay in registers.

_BUFFER_BYTES = 32 * 1024  # sensitivities of the outputs held between sums: stays in the first-level cache
TILE = 4


@lru_cache(maxsize=32)
def kernel_source(pattern: KernelPattern) -> str:
    """Return the C source of ``gbid_pass``, ``gbid_predict`` and ``gbid_adjoint``: one unit without includes."""
    n, n_z = pattern.G.shape
    n_y, n_p = pattern.C.shape[0], len(pattern.dF)
    padded = -(-(n_p + 1) // TILE) * TILE
    steps = max(4, _BUFFER_BYTES // (padded * n_y * 64))
    step = [*_outputs(pattern), *_state(pattern)]
    for i in range(n_p):
        step += _sensitivity(pattern, i)
    return _TEMPLATE.format(
        LANES=LANE_TYPES,
        N=n,
        NZ=n_z,
        NY=n_y,
        NP=n_p,
        NPP=padded,
        NT=-(-n // TILE) * TILE,
        STEPS=steps,
        TILE=TILE,
        STEP="\n".join("      " + line for line in step),
        PREDICT="\n".join("      " + line for line in [*_errors(pattern), *_state(pattern)]),
        BACK="\n".join("      " + line for line in _adjoint(pattern)),
    )


def _terms(row: BoolArray, coefficient: str, offset: int, vector: str) -> list[str]:
    """Return the products of a row's nonzeros with a vector: ``coefficient[offset + j] * vector[j]``."""
    return [f"{coefficient}[{offset + j}]*{vector}[{j}]" for j in np.flatnonzero(row)]


def _sum(terms: list[str]) -> str:
    """Return the sum of terms as C writes it; a zero without terms."""
    return " + ".join(terms) if terms else "zero"


def _errors(p: KernelPattern) -> list[str]:
    """Error of every output."""
    n_y, n = p.C.shape
    n_z = p.G.shape[1]
    lines = []
    for j in range(n_y):
        terms = _terms(p.C[j], "C", j * n, "x") + _terms(p.H[j], "H", j * n_z, "z")
        lines.append(f"e[{j}] = (y[{j}] - ({_sum(terms)})) * m;")
    return lines


def _outputs(p: KernelPattern) -> list[str]:
    """Error of every output and its weighted value."""
    n_y = len(p.C)
    lines = _errors(p)
    for a in range(n_y):
        lines.append(f"E[t*NY + {a}] = {_sum([f'R[{a * n_y + j}]*e[{j}]' for j in range(a, n_y)])};")
    lines += [f"ee[{a * n_y + b}] += e[{a}]*e[{b}];" for a in range(n_y) for b in range(a, n_y)]
    return lines


def _state(p: KernelPattern) -> list[str]:
    n, n_z = p.G.shape
    return [f"nx[{r}] = {_sum(_terms(p.F[r], 'F', r * n, 'x') + _terms(p.G[r], 'G', r * n_z, 'z'))};" for r in range(n)]


def _adjoint(p: KernelPattern) -> list[str]:
    """Step of the adjoint from the state after a sample to the state at it."""
    n = len(p.F)
    lines = []
    for c in range(n):
        back = [f"F[{r * n + c}]*a[{r}]" for r in np.flatnonzero(p.F[:, c])]
        out = [f"C[{j * n + c}]*w[{j}]" for j in np.flatnonzero(p.C[:, c])]
        lines.append(f"na[{c}] = {_sum(back)} - ({_sum(out)});")
    return lines


def _sensitivity(p: KernelPattern, i: int) -> list[str]:
    """Step of one parameter's sensitivity: outputs into the buffer, then the state."""
    n, n_z = p.G.shape
    n_y, live = len(p.C), p.live(i)
    lines = ["{", f"v *restrict s = S + {i * n};"]
    for j in range(n_y):
        terms = _terms(p.C[j] & live, "C", j * n, "s")
        terms += _terms(p.dC[i, j], "dC", (i * n_y + j) * n, "x") + _terms(p.dH[i, j], "dH", (i * n_y + j) * n_z, "z")
        lines.append(f"v q{j} = ({_sum(terms)}) * m;")
    for a in range(n_y):
        lines.append(f"P[{i}*BUF + t*NY + {a}] = {_sum([f'R[{a * n_y + j}]*q{j}' for j in range(a, n_y)])};")
    after = _state_sensitivity(p, i)
    lines += [f"v s{r} = {value};" for r, value in after.items()]
    lines += [f"s[{r}] = s{r};" for r in after]
    lines.append("}")
    return lines


def _state_sensitivity(p: KernelPattern, i: int) -> dict[int, str]:
    """Return for each state that depends on a parameter its sensitivity after a sample, from `s` at the sample."""
    (n, n_z), live = p.G.shape, p.live(i)
    return {
        int(r): _sum(
            _terms(p.F[r] & live, "F", r * n, "s")
            + _terms(p.dF[i, r], "dF", (i * n + r) * n, "x")
            + _terms(p.dG[i, r], "dG", (i * n + r) * n_z, "z")
        )
        for r in np.flatnonzero(live)
    }


LANE_TYPES = """\
typedef double v __attribute__((vector_size(64)));
typedef double u __attribute__((vector_size(64), aligned(8)));
static inline double total(v a) {
  double s = 0;
  for (int l = 0; l < 8; l++) s += a[l];
  return s;
}
"""
"""Vectors of eight blocks, aligned or not, and the sum over them."""

_TEMPLATE = """\
/* Written by gbid for one model structure: see gbid/identify/kernel/compiled_linear.py. */
{LANES}
#define N {N}
#define NZ {NZ}
#define NY {NY}
#define NP {NP}
#define NPP {NPP}
#define NT {NT}
#define BUF ({STEPS}*NY)
#define TILE {TILE}

/* Sums over the samples of one buffer, whose row after those of the parameters is the error. U are the roots of their
   weights, or NULL where all are 1 or 0: P has one root already, T has none. */
static void add_up(int rows, v *restrict P, const double *restrict T, const v *restrict U, v *restrict H,
                   v *restrict M) {{
  for (int i = 0; i < NPP; i += TILE)
    for (int j = i; j < NPP; j += TILE) {{
      v a[TILE][TILE];
      for (int p = 0; p < TILE; p++) for (int q = 0; q < TILE; q++) a[p][q] = H[(i + p)*NPP + j + q];
      for (int t = 0; t < rows; t++) {{
        v l[TILE], r[TILE];
        for (int p = 0; p < TILE; p++) l[p] = P[(i + p)*BUF + t];
        for (int q = 0; q < TILE; q++) r[q] = P[(j + q)*BUF + t];
        for (int p = 0; p < TILE; p++) for (int q = 0; q < TILE; q++) a[p][q] += l[p]*r[q];
      }}
      for (int p = 0; p < TILE; p++) for (int q = 0; q < TILE; q++) H[(i + p)*NPP + j + q] = a[p][q];
    }}
  if (U) for (int i = 0; i <= NP; i++) for (int t = 0; t < rows; t++) P[i*BUF + t] *= U[t];
  for (int i = 0; i < NPP; i += TILE)
    for (int c = 0; c < NT; c += TILE) {{
      v a[TILE][TILE];
      for (int p = 0; p < TILE; p++) for (int q = 0; q < TILE; q++) a[p][q] = M[(i + p)*NT + c + q];
      for (int t = 0; t < rows; t++) {{
        v l[TILE];
        for (int p = 0; p < TILE; p++) l[p] = P[(i + p)*BUF + t];
        for (int q = 0; q < TILE; q++) for (int p = 0; p < TILE; p++) a[p][q] += l[p]*T[t*NT + c + q];
      }}
      for (int p = 0; p < TILE; p++) for (int q = 0; q < TILE; q++) M[(i + p)*NT + c + q] = a[p][q];
    }}
}}

typedef struct {{ v P[NPP*BUF], U[BUF], hs[NPP*NPP], M[NPP*NT], S[NP*N]; }} workspace;

/* Arrays as documented for BlockSums, the eight blocks of a group innermost; T has NT columns. The workspace is handed
   over: its address would be looked up again and again within the loops. */
static void __attribute__((noinline)) pass_with(
    workspace *w, long groups, long length, const double *restrict F, const double *restrict G,
    const double *restrict C, const double *restrict H, const double *restrict dF, const double *restrict dG,
    const double *restrict dC, const double *restrict dH, const double *restrict R, const double *restrict T,
    const double *restrict zs, const double *restrict ys, const double *restrict used, const long long *restrict size,
    const double *restrict starts, double *restrict hessian, double *restrict products, double *restrict gradient,
    double *restrict gradient_start, double *restrict mixed, double *restrict end, double *restrict end_theta) {{
  const v zero = {{0}};
  v *restrict const P = w->P, *restrict const E = P + NP*BUF, *restrict const U = w->U, *restrict const hs = w->hs,
    *restrict const M = w->M, *restrict const S = w->S;
  v ee[NY*NY];
  for (int i = 0; i < NPP*BUF; i++) P[i] = zero;
  for (int i = 0; i < NPP*NPP; i++) hs[i] = zero;
  for (int i = 0; i < NY*NY; i++) ee[i] = zero;
  for (long b = 0; b < groups; b++) {{
    v x[N], nx[N], e[NY];
    for (int i = 0; i < NPP; i++) hs[i*NPP + NP] = zero; /* the gradient is that of a block */
    for (int i = 0; i < NPP*NT; i++) M[i] = zero;
    const long long *count = size + 8*b;
    int ragged = 0;
    for (int l = 0; l < 8; l++) ragged |= count[l] != length;
    for (int c = 0; c < N; c++) x[c] = *(const u *)(starts + (b*N + c)*8);
    for (int i = 0; i < NP*N; i++) S[i] = zero;
    double *restrict end_b = end + b*N*8, *restrict end_theta_b = end_theta + b*NP*N*8;
    if (ragged)
      for (int c = 0; c < N; c++) *(u *)(end_b + c*8) = x[c];
    int t = 0, weighted = 0;
    for (long k = b*length*8; k < (b + 1)*length*8; k++) weighted |= used[k] != 0 && used[k] != 1;
    for (long k = 0; k < length; k++) {{
      const u *z = (const u *)(zs + (b*length + k)*NZ*8);
      const u *y = (const u *)(ys + (b*length + k)*NY*8);
      const v m = *(const u *)(used + (b*length + k)*8);
{STEP}
      if (weighted) for (int j = 0; j < NY; j++) U[t*NY + j] = m;
      for (int c = 0; c < N; c++) x[c] = nx[c];
      for (int l = 0; ragged && l < 8; l++) {{
        if (count[l] != k + 1) continue;
        for (int c = 0; c < N; c++) end_b[c*8 + l] = x[c][l];
        for (int i = 0; i < NP*N; i++) end_theta_b[i*8 + l] = S[i][l];
      }}
      if (++t == BUF/NY || k + 1 == length) {{
        add_up(t*NY, P, T + (k + 1 - t)*NY*NT, weighted ? U : 0, hs, M);
        t = 0;
      }}
    }}
    if (!ragged) {{
      for (int c = 0; c < N; c++) *(u *)(end_b + c*8) = x[c];
      for (int i = 0; i < NP*N; i++) *(u *)(end_theta_b + i*8) = S[i];
    }}
    for (int i = 0; i < NP; i++) for (int c = 0; c < N; c++) *(u *)(mixed + ((b*NP + i)*N + c)*8) = M[i*NT + c];
    for (int i = 0; i < NP; i++) *(u *)(gradient + (b*NP + i)*8) = -hs[i*NPP + NP];
    for (int c = 0; c < N; c++) *(u *)(gradient_start + (b*N + c)*8) = -M[NP*NT + c];
  }}
  for (int i = 0; i < NP; i++)
    for (int j = i; j < NP; j++) hessian[i*NP + j] = hessian[j*NP + i] = total(hs[i*NPP + j]);
  for (int a = 0; a < NY; a++)
    for (int c = a; c < NY; c++) products[a*NY + c] = products[c*NY + a] = total(ee[a*NY + c]);
}}

void gbid_pass(long groups, long length, const double *F, const double *G, const double *C, const double *H,
               const double *dF, const double *dG, const double *dC, const double *dH, const double *R, const double *T,
               const double *zs, const double *ys, const double *used, const long long *size, const double *starts,
               double *h, double *products, double *g, double *gx, double *m, double *end, double *end_theta) {{
  static __thread workspace w;
  pass_with(&w, groups, length, F, G, C, H, dF, dG, dC, dH, R, T, zs, ys, used, size, starts, h, products, g, gx, m,
            end, end_theta);
}}

/* States, errors, and the products of errors of each block, from given starts. Without `states` the products alone. */
void gbid_predict(long groups, long length,
                  const double *restrict F, const double *restrict G, const double *restrict C,
                  const double *restrict H, const double *restrict zs, const double *restrict ys,
                  const double *restrict used, const double *restrict starts,
                  double *restrict states, double *restrict errors, double *restrict end, double *restrict products) {{
  const v zero = {{0}};
  for (long b = 0; b < groups; b++) {{
    v x[N], nx[N], e[NY], ee[NY*NY];
    for (int c = 0; c < N; c++) x[c] = *(const u *)(starts + (b*N + c)*8);
    for (int i = 0; i < NY*NY; i++) ee[i] = zero;
    for (long k = 0; k < length; k++) {{
      const u *z = (const u *)(zs + (b*length + k)*NZ*8);
      const u *y = (const u *)(ys + (b*length + k)*NY*8);
      const v m = *(const u *)(used + (b*length + k)*8);
{PREDICT}
      if (states) for (int c = 0; c < N; c++) *(u *)(states + ((b*length + k)*N + c)*8) = x[c];
      if (states) for (int j = 0; j < NY; j++) *(u *)(errors + ((b*length + k)*NY + j)*8) = e[j];
      for (int i = 0; i < NY; i++) for (int j = 0; j < NY; j++) ee[i*NY + j] += e[i]*e[j];
      for (int c = 0; c < N; c++) x[c] = nx[c];
    }}
    if (states) for (int c = 0; c < N; c++) *(u *)(end + (b*N + c)*8) = x[c];
    for (int i = 0; i < NY*NY; i++) *(u *)(products + (b*NY*NY + i)*8) = ee[i];
  }}
}}

/* Adjoint of the cost, backwards from its value at the end of each block; and sums of its products with states and
   regressors, rows those of F and G, then those of C and H. */
void gbid_adjoint(long groups, long length, const double *restrict F, const double *restrict C,
                  const double *restrict weighted, const double *restrict states, const double *restrict zs,
                  const long long *restrict size, const double *restrict last,
                  double *restrict first, double *restrict factors, double *restrict sums) {{
  const v zero = {{0}};
  v S[N + NY][N + NZ];
  for (int i = 0; i < N + NY; i++) for (int j = 0; j < N + NZ; j++) S[i][j] = zero;
  for (long b = 0; b < groups; b++) {{
    v a[N], na[N];
    for (int c = 0; c < N; c++) a[c] = zero;
    for (long k = length - 1; k >= 0; k--) {{
      const u *x = (const u *)(states + (b*length + k)*N*8);
      const u *z = (const u *)(zs + (b*length + k)*NZ*8);
      const u *w = (const u *)(weighted + (b*length + k)*NY*8);
      for (int l = 0; l < 8; l++)
        if (size[8*b + l] == k + 1)
          for (int c = 0; c < N; c++) a[c][l] = last[(b*N + c)*8 + l];
      u *f = (u *)(factors + (b*length + k)*(N + NY)*8);
      for (int c = 0; c < N; c++) f[c] = a[c];
      for (int j = 0; j < NY; j++) f[N + j] = -w[j];
      for (int i = 0; i < N; i++) {{
        for (int j = 0; j < N; j++) S[i][j] += a[i]*x[j];
        for (int j = 0; j < NZ; j++) S[i][N + j] += a[i]*z[j];
      }}
      for (int i = 0; i < NY; i++) {{
        for (int j = 0; j < N; j++) S[N + i][j] -= w[i]*x[j];
        for (int j = 0; j < NZ; j++) S[N + i][N + j] -= w[i]*z[j];
      }}
{BACK}
      for (int c = 0; c < N; c++) a[c] = na[c];
    }}
    for (int c = 0; c < N; c++) *(u *)(first + (b*N + c)*8) = a[c];
  }}
  for (int i = 0; i < N + NY; i++) for (int j = 0; j < N + NZ; j++) sums[i*(N + NZ) + j] = total(S[i][j]);
}}
"""


# ---- C source of the second pass over the samples: products of the adjoint and the sensitivities of the states.
#
# It is a library of its own, because only fits with coloured errors need it.

_SECOND_BUFFER_BYTES = 96 * 1024  # factors of the products held between sums: stays in the first-level cache


@lru_cache(maxsize=32)
def second_source(pattern: KernelPattern) -> str:
    """Return the C source of ``gbid_second``: one unit without includes."""
    n, n_z = pattern.G.shape
    n_y, n_p = pattern.C.shape[0], len(pattern.dF)
    rows, columns = (-(-size // TILE) * TILE for size in (n + n_y, n_p * n))
    step = []
    for i in range(n_p):
        after = _state_sensitivity(pattern, i)
        step += ["{", f"const v *restrict s = before + {i * n};"]
        step += [*(f"next[{i * n + r}] = {value};" for r, value in after.items()), "}"]
    return _SECOND_TEMPLATE.format(
        LANES=LANE_TYPES,
        N=n,
        NZ=n_z,
        NY=n_y,
        NP=n_p,
        ROWS=rows,
        COLUMNS=columns,
        STEPS=max(4, _SECOND_BUFFER_BYTES // ((rows + columns) * 64)),
        TILE=TILE,
        STEP="\n".join("      " + line for line in step),
    )


_SECOND_TEMPLATE = """\
/* Written by gbid for one model structure: see gbid/identify/kernel/compiled_linear.py. */
{LANES}
#define N {N}
#define NZ {NZ}
#define NY {NY}
#define NP {NP}
#define ROWS {ROWS}
#define COLUMNS {COLUMNS}
#define STEPS {STEPS}
#define TILE {TILE}

/* Products over the samples of one buffer. */
static void add_up(int count, const v *restrict A, const v *restrict S, v *restrict P) {{
  for (int i = 0; i < ROWS; i += TILE)
    for (int j = 0; j < COLUMNS; j += TILE) {{
      v a[TILE][TILE];
      for (int p = 0; p < TILE; p++) for (int q = 0; q < TILE; q++) a[p][q] = P[(i + p)*COLUMNS + j + q];
      for (int t = 0; t < count; t++) {{
        v l[TILE], r[TILE];
        for (int p = 0; p < TILE; p++) l[p] = A[t*ROWS + i + p];
        for (int q = 0; q < TILE; q++) r[q] = S[t*COLUMNS + j + q];
        for (int p = 0; p < TILE; p++) for (int q = 0; q < TILE; q++) a[p][q] += l[p]*r[q];
      }}
      for (int p = 0; p < TILE; p++) for (int q = 0; q < TILE; q++) P[(i + p)*COLUMNS + j + q] = a[p][q];
    }}
}}

/* Arrays as documented for CompiledLinearKernel.second_pass, the eight blocks of a group innermost. */
void gbid_second(long groups, long length, const double *restrict F, const double *restrict dF,
                 const double *restrict dG, const double *restrict states, const double *restrict zs,
                 const double *restrict factors, double *restrict products, double *restrict end_theta) {{
  const v zero = {{0}};
  static __thread v A[STEPS*ROWS], S[(STEPS + 1)*COLUMNS], P[ROWS*COLUMNS];
  (void)dG;
  for (int i = 0; i < ROWS*COLUMNS; i++) P[i] = zero;
  for (int i = 0; i < STEPS*ROWS; i++) A[i] = zero;
  for (int i = 0; i < (STEPS + 1)*COLUMNS; i++) S[i] = zero;
  for (long b = 0; b < groups; b++) {{
    int t = 0;
    for (int i = 0; i < COLUMNS; i++) S[i] = zero;
    for (long k = 0; k < length; k++) {{
      const u *x = (const u *)(states + (b*length + k)*N*8);
      const u *z = (const u *)(zs + (b*length + k)*NZ*8);
      const u *f = (const u *)(factors + (b*length + k)*(N + NY)*8);
      const v *restrict before = S + t*COLUMNS;
      v *restrict next = S + (t + 1)*COLUMNS;
      for (int i = 0; i < N + NY; i++) A[t*ROWS + i] = f[i];
{STEP}
      if (++t == STEPS || k + 1 == length) {{
        add_up(t, A, S, P);
        for (int i = 0; i < COLUMNS; i++) S[i] = S[t*COLUMNS + i];
        t = 0;
      }}
    }}
    for (int i = 0; i < NP*N; i++) *(u *)(end_theta + (b*NP*N + i)*8) = S[i];
  }}
  for (int i = 0; i < N + NY; i++)
    for (int j = 0; j < NP*N; j++) products[i*NP*N + j] = total(P[i*COLUMNS + j]);
}}
"""


# ---- Kernel.

_CHUNK = 8  # samples that sensitivities.c holds before it writes them
LONGEST_SOURCE = 200_000
"""Longest kernel that is compiled, in characters: 55 000 (12 states) take seconds, 480 000 (28 states) minutes."""


class CompiledLinearKernel(LinearKernel):
    """Compiled kernel of a linear predictor, built for the nonzeros that it has met; a `Kernel`.

    Parameters
    ----------
    pattern : KernelPattern
        Entries of the predictor's matrices that may differ from zero. The kernel is built anew when others are met.

    Raises
    ------
    CompilerMissingError
        When there is no compiler, or when it fails.
    """

    def __init__(self, pattern: KernelPattern) -> None:
        self._known: PredictorValues | None = None
        self._build(pattern)

    def _build(self, pattern: KernelPattern) -> None:
        self._pattern = pattern
        library = load_library(kernel_source(pattern))
        self.note = library.note
        self._pass, self._predict, self._adjoint = library.gbid_pass, library.gbid_predict, library.gbid_adjoint
        self._second: Any = None  # compiled when it is needed first

    def _regressors(self, v: PredictorValues, blocks: Blocks) -> FloatArray:
        """Return the regressors; build the kernel anew if the predictor has new nonzeros."""
        if v is not self._known:  # a gradient runs four passes of one predictor
            pattern = KernelPattern.of(v)
            if not self._pattern.covers(pattern):
                self._build(self._pattern.union(pattern))
            self._known = v
        return blocks.z(v.shift)

    def sums(
        self, v: PredictorValues, blocks: Blocks, begin: FloatArray, root: FloatArray, free: FloatArray
    ) -> BlockSums:
        """Return the sums of the pass with sensitivities; see `LinearKernel`."""
        z = self._regressors(v, blocks)
        n, n_p, n_y = len(v.F), len(v.dF), len(v.C)
        n_groups, length, _, lanes = z.shape
        hessian, products = np.empty((n_p, n_p)), np.empty((n_y, n_y))
        gradient = np.empty((n_groups, n_p, lanes))
        gradient_start, end = np.empty((n_groups, n, lanes)), np.empty((n_groups, n, lanes))
        mixed, end_theta = np.empty((n_groups, n_p, n, lanes)), np.zeros((n_groups, n_p, n, lanes))
        response = np.zeros((length, n_y, -(-n // TILE) * TILE))
        response[:, :, :n] = free
        arrays = [*v[:8], root, response, z, blocks.y, blocks.used, blocks.size, blocks.by_group(begin)]
        results = [hessian, products, gradient, gradient_start, mixed, end, end_theta]
        run_compiled(self._pass, (n_groups, length), arrays, results)
        return BlockSums(
            hessian,
            products,
            per_block(gradient),
            per_block(gradient_start),
            per_block(mixed),
            per_block(end),
            per_block(end_theta).transpose(0, 2, 1),
        )

    def passed(self, v: PredictorValues, blocks: Blocks, begin: FloatArray) -> Prediction:
        """Return states and errors from the starts of blocks; see `Kernel`."""
        n_groups, length, _, lanes = blocks.y.shape
        n = len(v.F)
        states, errors = np.empty((n_groups, length, n, lanes)), np.empty_like(blocks.y)
        end = np.empty((n_groups, n, lanes))
        self._errors(v, blocks, begin, [states, errors, end])
        return Prediction(states, errors, end.transpose(1, 0, 2).reshape(n, -1))

    def products_of(self, v: PredictorValues, blocks: Blocks, begin: FloatArray) -> FloatArray:
        """Return the products of the errors of each block; see `LinearKernel`."""
        return self._errors(v, blocks, begin, [None, None, None])

    def _errors(
        self, v: PredictorValues, blocks: Blocks, begin: FloatArray, results: Sequence[FloatArray | None]
    ) -> FloatArray:
        """Return the products of the errors of each block; write states, errors and ends to `results`."""
        z, (n_groups, length, n_y, lanes) = self._regressors(v, blocks), blocks.y.shape
        products = np.empty((n_groups, n_y, n_y, lanes))
        arrays = [*v[:4], z, blocks.y, blocks.used, blocks.by_group(begin)]
        run_compiled(self._predict, (n_groups, length), arrays, [*results, products])
        return per_block(products)

    def adjoint_pass(
        self, v: PredictorValues, blocks: Blocks, weighted: FloatArray, states: FloatArray, last: FloatArray
    ) -> Backwards:
        """Run the adjoint backwards in each block; see `LinearKernel`."""
        z = self._regressors(v, blocks)
        n_groups, length, n_z, lanes = z.shape
        n, n_y = len(v.F), len(v.C)
        first, sums = np.empty((n_groups, n, lanes)), np.empty((n + n_y, n + n_z))
        factors = np.empty((n_groups, length, n + n_y, lanes))
        arrays = [v.F, v.C, weighted, states, z, blocks.size, blocks.by_group(last)]
        run_compiled(self._adjoint, (n_groups, length), arrays, [first, factors, sums])
        return Backwards(states, first.transpose(1, 0, 2).reshape(n, -1), sums, factors)

    def second_pass(self, v: PredictorValues, blocks: Blocks, back: Backwards) -> tuple[FloatArray, FloatArray]:
        """Return the products of the adjoint and the sensitivities of the states; see `LinearKernel`."""
        z = self._regressors(v, blocks)
        if self._second is None:
            self._second = load_library(second_source(self._pattern)).gbid_second
        n_groups, length, _, lanes = z.shape
        n_p, n, _ = v.dF.shape
        products, end_theta = np.empty((back.factors.shape[2], n_p, n)), np.empty((n_groups, n_p, n, lanes))
        arrays = [v.F, v.dF, v.dG, back.states, z, back.factors]
        run_compiled(self._second, (n_groups, length), arrays, [products, end_theta])
        return products, per_block(end_theta).transpose(0, 2, 1)

    def sensitivities(
        self, v: PredictorValues, blocks: Blocks, prediction: Prediction, linked: Linked, some: slice
    ) -> FloatArray:
        """Return the sensitivities of some blocks; see `Kernel`."""
        z = self._regressors(v, blocks)
        n_z, (n_p, n, _), n_y, length = z.shape[2], v.dF.shape, len(v.C), blocks.length
        m, count = n_p + n, some.stop - some.start
        onto_state = np.concatenate([v.dF, v.dG], axis=2).reshape(n_p * n, -1)
        onto_output = np.concatenate([v.dC, v.dH], axis=2).reshape(n_p * n_y, -1)
        entries = [array for matrix in (v.F, v.C, onto_state, onto_output) for array in _by_rows(matrix)]
        starts = np.concatenate([linked.by_theta[some], linked.by_start[some]], axis=2).transpose(0, 2, 1)
        sides = _aligned((2 * m * n + n + n_z + m * n_y * _CHUNK) * LANES)
        psi = np.empty((n_y * m, count, length))
        run = load_library(_sensitivity_source()).gbid_sensitivities
        sizes = (n, n_p, n_y, n_z, length, some.start, some.stop)
        run_compiled(run, sizes, [*entries, prediction.states, z, blocks.used, starts], [sides, psi])
        return psi


def run_compiled(
    function: Any,
    sizes: Sequence[int],
    arrays: Sequence[npt.NDArray[Any]],
    results: Sequence[npt.NDArray[Any] | None],
) -> None:
    """Call a compiled function of sizes (long), arrays that it reads, and contiguous arrays that it writes, or NULL."""
    given = [np.ascontiguousarray(array) for array in arrays]  # kept until the call has ended
    function.restype = None
    function(*map(ctypes.c_long, sizes), *(None if array is None else _pointer(array) for array in [*given, *results]))


def _pointer(array: npt.NDArray[Any]) -> ctypes.c_void_p:
    """Return the address of an array for C."""
    return ctypes.c_void_p(array.__array_interface__["data"][0])  # half the time of array.ctypes


def _by_rows(matrix: FloatArray) -> tuple[IntArray, IntArray, FloatArray]:
    """Return where the rows of a matrix without its zeros begin and end, and the columns and values of its entries."""
    rows, columns = np.nonzero(matrix)
    ends = np.searchsorted(rows, np.arange(len(matrix) + 1)).astype(np.int64)
    return ends, columns.astype(np.int64), matrix[rows, columns]


def _aligned(size: int) -> FloatArray:
    """Return an array of so many numbers at an address of a vector."""
    room = np.empty(size + LANES)
    return room[-(room.__array_interface__["data"][0] // 8) % LANES :][:size]


@lru_cache(maxsize=1)
def _sensitivity_source() -> str:
    return files("gbid.identify.kernel").joinpath("sensitivities.c").read_text(encoding="utf-8")
