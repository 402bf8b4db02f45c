"""Entries of the predictor's matrices that may differ from zero."""

from __future__ import annotations

import ctypes
from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache
from importlib.resources import files
from typing import Any, Literal, NamedTuple

import numpy as np
import numpy.typing as npt

from gbid.core.arrays import BoolArray, FloatArray, IntArray
from gbid.core.compiled import CompilerMissingError, load_library
from gbid.core.errors import UsageError
from gbid.identify.kernel.blocks import LANES as LANES_BLOCKS
from gbid.identify.kernel.blocks import Adjoint, Blocks, BlockSums, PassEngine, Prediction, Second
from gbid.identify.kernel.sums import (
    Linked,
    Moved,
    Sweep,
    Traced,
    block_sums,
    from_starts,
    joined,
    link,
    powers_of,
    run_with_numpy,
    scan,
    spectral_radius,
    start_hessians,
    starts_of_blocks,
    sweep,
)
from gbid.identify.predictor import PredictorValues


@dataclass(frozen=True, eq=False)
class KernelPattern:
    """Pattern of the entries of the predictor's matrices that may differ from zero.

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
        """Return which states ever depend on a parameter, when none does at the start, (n,)."""
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


def kernel_source(pattern: KernelPattern) -> str:
    """Write the C source of ``gbid_pass`` for a pattern.

    Parameters
    ----------
    pattern : KernelPattern

    Returns
    -------
    str
        One translation unit without includes.
    """
    n, n_z = pattern.G.shape
    n_y, n_p = pattern.C.shape[0], len(pattern.dF)
    padded = -(-(n_p + 1) // TILE) * TILE
    steps = max(4, _BUFFER_BYTES // (padded * n_y * 64))
    step = [*_outputs(pattern), *_state(pattern)]
    for i in range(n_p):
        step += _sensitivity(pattern, i)
    return _TEMPLATE.format(
        LANES=LANES,
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


def terms_of(row: BoolArray, coefficient: str, offset: int, vector: str) -> list[str]:
    """Return the products of a row's nonzeros with a vector: ``coefficient[offset + j] * vector[j]``."""
    return [f"{coefficient}[{offset + j}]*{vector}[{j}]" for j in np.flatnonzero(row)]


def sum_of(terms: list[str]) -> str:
    """Return the sum of terms as C writes it; a zero without terms."""
    return " + ".join(terms) if terms else "zero"


def _errors(p: KernelPattern) -> list[str]:
    """Error of every output."""
    n_y, n = p.C.shape
    n_z = p.G.shape[1]
    lines = []
    for j in range(n_y):
        terms = terms_of(p.C[j], "C", j * n, "x") + terms_of(p.H[j], "H", j * n_z, "z")
        lines.append(f"e[{j}] = (y[{j}] - ({sum_of(terms)})) * m;")
    return lines


def _outputs(p: KernelPattern) -> list[str]:
    """Error of every output and its weighted value."""
    n_y = len(p.C)
    lines = _errors(p)
    for a in range(n_y):
        lines.append(f"E[t*NY + {a}] = {sum_of([f'R[{a * n_y + j}]*e[{j}]' for j in range(a, n_y)])};")
    lines += [f"ee[{a * n_y + b}] += e[{a}]*e[{b}];" for a in range(n_y) for b in range(a, n_y)]
    return lines


def _state(p: KernelPattern) -> list[str]:
    n, n_z = p.G.shape
    return [
        f"nx[{r}] = {sum_of(terms_of(p.F[r], 'F', r * n, 'x') + terms_of(p.G[r], 'G', r * n_z, 'z'))};"
        for r in range(n)
    ]


def _adjoint(p: KernelPattern) -> list[str]:
    """Step of the adjoint from the state after a sample to the state at it."""
    n = len(p.F)
    lines = []
    for c in range(n):
        back = [f"F[{r * n + c}]*a[{r}]" for r in np.flatnonzero(p.F[:, c])]
        out = [f"C[{j * n + c}]*w[{j}]" for j in np.flatnonzero(p.C[:, c])]
        lines.append(f"na[{c}] = {sum_of(back)} - ({sum_of(out)});")
    return lines


def _sensitivity(p: KernelPattern, i: int) -> list[str]:
    """Step of one parameter's sensitivity: outputs into the buffer, then the state."""
    n, n_z = p.G.shape
    n_y, live = len(p.C), p.live(i)
    lines = ["{", f"v *restrict s = S + {i * n};"]
    for j in range(n_y):
        terms = terms_of(p.C[j] & live, "C", j * n, "s")
        terms += terms_of(p.dC[i, j], "dC", (i * n_y + j) * n, "x") + terms_of(
            p.dH[i, j], "dH", (i * n_y + j) * n_z, "z"
        )
        lines.append(f"v q{j} = ({sum_of(terms)}) * m;")
    for a in range(n_y):
        lines.append(f"P[{i}*BUF + t*NY + {a}] = {sum_of([f'R[{a * n_y + j}]*q{j}' for j in range(a, n_y)])};")
    for r in np.flatnonzero(live):
        terms = terms_of(p.F[r] & live, "F", r * n, "s")
        terms += terms_of(p.dF[i, r], "dF", (i * n + r) * n, "x") + terms_of(p.dG[i, r], "dG", (i * n + r) * n_z, "z")
        lines.append(f"v s{r} = {sum_of(terms)};")
    lines += [f"s[{r}] = s{r};" for r in np.flatnonzero(live)]
    lines.append("}")
    return lines


LANES = """\
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
/* Written by gbid for one model structure: see gbid/identify/kernel/linear.py. */
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
# With the first pass (`gbid.identify.kernel.linear`) it shares the lanes and the pattern of nonzeros. It is a library
# of
# its own, because only fits with coloured errors need it.

_BUFFER_BYTES_SECOND_SOURCE = 96 * 1024  # factors of the products held between sums: stays in the first-level cache
_TILE = 4


def second_source(pattern: KernelPattern) -> str:
    """Write the C source of ``gbid_second`` for a pattern.

    Parameters
    ----------
    pattern : KernelPattern

    Returns
    -------
    str
        One translation unit without includes.
    """
    n, n_z = pattern.G.shape
    n_y, n_p = pattern.C.shape[0], len(pattern.dF)
    rows, columns = (-(-size // _TILE) * _TILE for size in (n + n_y, n_p * n))
    return _TEMPLATE_SECOND_SOURCE.format(
        LANES=LANES,
        N=n,
        NZ=n_z,
        NY=n_y,
        NP=n_p,
        ROWS=rows,
        COLUMNS=columns,
        STEPS=max(4, _BUFFER_BYTES_SECOND_SOURCE // ((rows + columns) * 64)),
        TILE=_TILE,
        STEP="\n".join("      " + line for i in range(n_p) for line in _sensitivity_second_source(pattern, i)),
    )


def _sensitivity_second_source(p: KernelPattern, i: int) -> list[str]:
    """Sensitivity of the state by one parameter after a sample, from that at it."""
    n, n_z = p.G.shape
    lines = []
    live = p.live(i)
    for r in np.flatnonzero(live):
        terms = [f"F[{r * n + c}]*s[{i * n + c}]" for c in np.flatnonzero(p.F[r] & live)]
        terms += terms_of(p.dF[i, r], "dF", (i * n + r) * n, "x") + terms_of(p.dG[i, r], "dG", (i * n + r) * n_z, "z")
        lines.append(f"next[{i * n + r}] = {sum_of(terms)};")
    return lines


_TEMPLATE_SECOND_SOURCE = """\
/* Written by gbid for one model structure: see gbid/identify/kernel/linear.py. */
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

/* Arrays as documented for PassEngine.second, the eight blocks of a group innermost. */
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
      const v *restrict s = S + t*COLUMNS;
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


# ---- Choice of the engine that runs the pass: the compiled kernel, or numpy without a compiler.

EngineName = Literal["auto", "compiled", "numpy"]
RunEngine = Literal["compiled", "numpy"]
_CHUNK = 8  # samples that sensitivities.c holds before it writes them
LONGEST_SOURCE = 200_000
"""Longest kernel that is compiled, in characters: 55 000 (12 states) take seconds, 480 000 (28 states) minutes."""


class ChosenEngine(NamedTuple):
    """Engine with its name and a note.

    Attributes
    ----------
    run : PassEngine
        The engine.
    name : {"compiled", "numpy"}
        Its name.
    note : str
        Reason why it is not the compiled one, if that was wanted, or is not taken from the cache; else empty.
    """

    run: PassEngine
    name: RunEngine
    note: str


def choose_engine(wanted: EngineName, samples: list[PredictorValues]) -> ChosenEngine:
    """Return the engine for predictors of one size.

    Parameters
    ----------
    wanted : {"auto", "compiled", "numpy"}
        ``"auto"`` is the compiled kernel if there is a C compiler and the predictor is not too large to be compiled in
        seconds; otherwise the note says why it is numpy.
    samples : list of PredictorValues
        The predictor at some parameter values, which show the entries that are always zero.

    Returns
    -------
    ChosenEngine
        Engine with its name and a note.

    Raises
    ------
    UsageError
        When the compiled kernel is required and there is no compiler.
    """
    if wanted not in ("auto", "compiled", "numpy"):
        raise UsageError(f"engine = {wanted!r}; choose 'auto', 'compiled' or 'numpy'")
    if wanted == "numpy":
        return ChosenEngine(run_with_numpy, "numpy", "")
    if wanted == "auto" and len(_source(_arrays(_pattern(samples)))) > LONGEST_SOURCE:
        told = f"a compiled pass for {len(samples[0].F)} states would take minutes to build: the numpy pass was used"
        return ChosenEngine(run_with_numpy, "numpy", told)
    try:
        engine = CompiledEngine(samples)
        return ChosenEngine(engine, "compiled", engine.note)
    except CompilerMissingError as missing:
        if wanted == "compiled":
            raise UsageError(f"engine = 'compiled': {missing}") from None
        return ChosenEngine(run_with_numpy, "numpy", f"{missing}: the slower numpy pass was used")


class CompiledEngine:
    """The pass as compiled C, built for the nonzeros that it has met; an `PassEngine`.

    Parameters
    ----------
    samples : list of PredictorValues
    """

    def __init__(self, samples: list[PredictorValues]) -> None:
        self._known: PredictorValues | None = None
        self._build(_pattern(samples))

    def _build(self, pattern: KernelPattern) -> None:
        self._pattern = pattern
        arrays = _arrays(pattern)
        library = load_library(_source(arrays))
        self._pass, self._predict, self._adjoint = library.gbid_pass, library.gbid_predict, library.gbid_adjoint
        self.note = library.note
        self._pass.restype = self._predict.restype = self._adjoint.restype = None
        self._second: Any = None  # compiled when it is needed first

    def _fit_for(self, v: PredictorValues, blocks: Blocks) -> FloatArray:
        """Rebuild the kernel if the predictor has new nonzeros; return the regressors."""
        if v is not self._known:  # a gradient runs four passes of one predictor
            met = pattern_of(v)
            if not self._pattern.covers(met):
                self._build(self._pattern.union(met))
            self._known = v
        if blocks.lanes != LANES_BLOCKS:
            raise UsageError(f"the compiled pass needs {LANES_BLOCKS} blocks in a group, not {blocks.lanes}")
        return blocks.z(v.shift)

    def __call__(
        self, v: PredictorValues, blocks: Blocks, starts: FloatArray, root: FloatArray, free: FloatArray
    ) -> BlockSums:
        """Run the pass; see `PassEngine`."""
        z = self._fit_for(v, blocks)
        n, n_p, n_y = len(v.F), len(v.dF), len(v.C)
        n_groups, length, _, lanes = z.shape
        by_group = np.ascontiguousarray(starts.reshape(n_groups, lanes, n).transpose(0, 2, 1))
        hessian, products = np.empty((n_p, n_p)), np.empty((n_y, n_y))
        gradient = np.empty((n_groups, n_p, lanes))
        gradient_start, end = np.empty((n_groups, n, lanes)), np.empty((n_groups, n, lanes))
        mixed, end_theta = np.empty((n_groups, n_p, n, lanes)), np.zeros((n_groups, n_p, n, lanes))
        size = np.ascontiguousarray(blocks.size, np.int64)
        response = np.zeros((length, n_y, -(-n // TILE) * TILE))
        response[:, :, :n] = free
        arrays = [*(np.ascontiguousarray(a) for a in v[:8]), root, response, z, blocks.y, blocks.used, size, by_group]
        results = [hessian, products, gradient, gradient_start, mixed, end, end_theta]
        self._pass(ctypes.c_long(n_groups), ctypes.c_long(length), *(pointer_of(a) for a in arrays + results))
        return BlockSums(
            hessian,
            products,
            _per_block(gradient),
            _per_block(gradient_start),
            _per_block(mixed),
            _per_block(end),
            _per_block(end_theta).transpose(0, 2, 1),
        )

    def predict(self, v: PredictorValues, blocks: Blocks, starts: FloatArray) -> Prediction:
        """Run the state alone; see `PassEngine`."""
        n_groups, length, _, lanes = blocks.y.shape
        n = len(v.F)
        states, errors = np.empty((n_groups, length, n, lanes)), np.empty_like(blocks.y)
        end = np.empty((n_groups, n, lanes))
        self._errors(v, blocks, starts, [states, errors, end])
        return Prediction(states, errors, end.transpose(1, 0, 2).reshape(n, -1))

    def products(self, v: PredictorValues, blocks: Blocks, starts: FloatArray) -> FloatArray:
        """Return the products of the errors of each block; see `PassEngine`."""
        return self._errors(v, blocks, starts, [])

    def _errors(
        self, v: PredictorValues, blocks: Blocks, starts: FloatArray, results: Sequence[FloatArray]
    ) -> FloatArray:
        """Run the state alone, for the products of errors and further results."""
        z, (n_groups, length, n_y, lanes) = self._fit_for(v, blocks), blocks.y.shape
        products = np.empty((n_groups, n_y, n_y, lanes))
        arrays = [*(np.ascontiguousarray(a) for a in v[:4]), z, blocks.y, blocks.used, _by_group(starts)]
        pointers = [*map(pointer_of, [*arrays, *results]), *[None] * (3 - len(results)), pointer_of(products)]
        self._predict(ctypes.c_long(n_groups), ctypes.c_long(length), *pointers)
        return _per_block(products)

    def adjoint(
        self, v: PredictorValues, blocks: Blocks, weighted: FloatArray, states: FloatArray, last: FloatArray
    ) -> Adjoint:
        """Run the adjoint backwards; see `PassEngine`."""
        z = self._fit_for(v, blocks)
        n_groups, length, n_z, lanes = z.shape
        n, n_y = len(v.F), len(v.C)
        first, sums = np.empty((n_groups, n, lanes)), np.empty((n + n_y, n + n_z))
        factors = np.empty((n_groups, length, n + n_y, lanes))
        size = np.ascontiguousarray(blocks.size, np.int64)
        arrays = [np.ascontiguousarray(a) for a in (v.F, v.C, weighted, states)] + [z, size, _by_group(last)]
        pointers = (pointer_of(a) for a in [*arrays, first, factors, sums])
        self._adjoint(ctypes.c_long(n_groups), ctypes.c_long(length), *pointers)
        return Adjoint(first.transpose(1, 0, 2).reshape(n, -1), sums, factors)

    def second(self, v: PredictorValues, blocks: Blocks, states: FloatArray, factors: FloatArray) -> Second:
        """Run the sensitivities of the states; see `PassEngine`."""
        z = self._fit_for(v, blocks)
        if self._second is None:
            self._second = load_library(_second_source(_arrays(self._pattern))).gbid_second
            self._second.restype = None
        n_groups, length, _, lanes = z.shape
        n_p, n, _ = v.dF.shape
        products, end_theta = np.empty((factors.shape[2], n_p, n)), np.empty((n_groups, n_p, n, lanes))
        arrays = [*(np.ascontiguousarray(a) for a in (v.F, v.dF, v.dG, states)), z, np.ascontiguousarray(factors)]
        pointers = (pointer_of(a) for a in [*arrays, products, end_theta])
        self._second(ctypes.c_long(n_groups), ctypes.c_long(length), *pointers)
        return Second(products, _per_block(end_theta).transpose(0, 2, 1))

    def sensitivities(
        self, v: PredictorValues, blocks: Blocks, prediction: Prediction, first: FloatArray, own: slice
    ) -> FloatArray:
        """Return the sensitivities of some blocks; see `PassEngine`."""
        z = self._fit_for(v, blocks)
        n_z, (n_p, n, _), n_y, length = z.shape[2], v.dF.shape, len(v.C), blocks.length
        m, count = n_p + n, own.stop - own.start
        onto_state = np.concatenate([v.dF, v.dG], axis=2).reshape(n_p * n, -1)
        onto_output = np.concatenate([v.dC, v.dH], axis=2).reshape(n_p * n_y, -1)
        entries = [array for matrix in (v.F, v.C, onto_state, onto_output) for array in _by_rows(matrix)]
        states, starts = np.ascontiguousarray(prediction.states), np.ascontiguousarray(first.transpose(0, 2, 1))
        sides = _aligned((2 * m * n + n + n_z + m * n_y * _CHUNK) * LANES_BLOCKS)
        psi = np.empty((n_y * m, count, length))
        run = load_library(_sensitivity_source()).gbid_sensitivities
        run.restype = None
        sizes = (ctypes.c_long(size) for size in (n, n_p, n_y, n_z, length, own.start, own.stop))
        run(*sizes, *map(pointer_of, [*entries, states, z, blocks.used, starts, sides, psi]))
        return psi


def _by_rows(matrix: FloatArray) -> tuple[IntArray, IntArray, FloatArray]:
    """Return where the rows of a matrix without its zeros begin and end, and the columns and values of its entries."""
    rows, columns = np.nonzero(matrix)
    ends = np.searchsorted(rows, np.arange(len(matrix) + 1)).astype(np.int64)
    return ends, columns.astype(np.int64), np.ascontiguousarray(matrix[rows, columns])


def _aligned(size: int) -> FloatArray:
    """Return an array of so many numbers at an address of a vector."""
    room = np.empty(size + LANES_BLOCKS)
    return room[-(room.__array_interface__["data"][0] // 8) % LANES_BLOCKS :][:size]


@lru_cache(maxsize=1)
def _sensitivity_source() -> str:
    return files("gbid.identify.kernel").joinpath("sensitivities.c").read_text(encoding="utf-8")


@lru_cache(maxsize=32)
def _source(arrays: tuple[tuple[tuple[int, ...], bytes], ...]) -> str:
    """Source for a pattern given as shapes and bytes: written once in a process."""
    return kernel_source(_kernel_pattern(arrays))


@lru_cache(maxsize=32)
def _second_source(arrays: tuple[tuple[tuple[int, ...], bytes], ...]) -> str:
    """Source of the second pass: written once in a process."""
    return second_source(_kernel_pattern(arrays))


def _kernel_pattern(arrays: tuple[tuple[tuple[int, ...], bytes], ...]) -> KernelPattern:
    return KernelPattern(*(np.frombuffer(data, np.bool_).reshape(shape) for shape, data in arrays))


def pattern_of(v: PredictorValues) -> KernelPattern:
    """Entries that differ from zero at one parameter value."""
    return KernelPattern(*(array != 0 for array in v[:8]))


def _pattern(samples: list[PredictorValues]) -> KernelPattern:
    """Return the entries that differ from zero at one of several parameter values."""
    pattern = pattern_of(samples[0])
    for sample in samples[1:]:
        pattern = pattern.union(pattern_of(sample))
    return pattern


def _arrays(pattern: KernelPattern) -> tuple[tuple[tuple[int, ...], bytes], ...]:
    return tuple((array.shape, array.tobytes()) for array in pattern.arrays())


def _by_group(values: FloatArray) -> FloatArray:
    """(n, W) to (n_groups, n, lanes)."""
    return np.ascontiguousarray(values.reshape(len(values), -1, LANES_BLOCKS).transpose(1, 0, 2))


def _per_block(values: FloatArray) -> FloatArray:
    """(n_groups, ..., lanes) to (W, ...)."""
    return np.ascontiguousarray(np.moveaxis(values, -1, 1)).reshape(-1, *values.shape[1:-1])


def pointer_of(array: npt.NDArray[np.generic]) -> ctypes.c_void_p:
    """Return the address of an array for C."""
    return ctypes.c_void_p(array.__array_interface__["data"][0])  # half the time of array.ctypes


# ---- Kernel of linear predictors: recursion of all blocks by an engine, and links by powers of the transition.


@dataclass(frozen=True, eq=False)
class LinearKernel:
    """Kernel of a linear predictor; a `Kernel`.

    Attributes
    ----------
    run : PassEngine
        Engine of the recursion over the blocks.
    """

    run: PassEngine

    def sweep(self, v: PredictorValues, blocks: Blocks, starts: FloatArray, weight: FloatArray) -> Sweep:
        """Return the sums over the samples; see `Kernel`."""
        return sweep(v, blocks, starts, weight, self.run)

    def trace(
        self, v: PredictorValues, blocks: Blocks, starts: FloatArray, weights: Sequence[FloatArray]
    ) -> list[Traced]:
        """Return the sums of each block for each weight; see `Kernel`."""
        powers = powers_of(v.F, blocks.length)
        begin = starts_of_blocks(v, blocks, starts, powers[-1], self.run)
        found = []
        for weight in weights:
            sums, free = block_sums(v, blocks, begin, weight, powers, self.run)
            linked = link(blocks, sums.end_theta, powers)
            found.append(Traced(begin, joined(blocks, sums, start_hessians(blocks, free), linked), linked, sums))
        return found

    def begin(self, v: PredictorValues, blocks: Blocks, starts: FloatArray) -> FloatArray:
        """Return the state at the start of each block; see `Kernel`."""
        return starts_of_blocks(v, blocks, starts, powers_of(v.F, blocks.length)[-1], self.run)

    def predict(self, v: PredictorValues, blocks: Blocks, starts: FloatArray) -> Prediction:
        """Return states and errors; see `Kernel`."""
        return from_starts(v, blocks, starts, self.run)

    def passed(self, v: PredictorValues, blocks: Blocks, begin: FloatArray) -> Prediction:
        """Return states and errors from the starts of blocks; see `Kernel`."""
        return self.run.predict(v, blocks, begin)

    def products(self, v: PredictorValues, blocks: Blocks, starts: FloatArray) -> FloatArray:
        """Return the products of the errors of each block; see `Kernel`."""
        return self.run.products(v, blocks, self.begin(v, blocks, starts))

    def gradient(
        self, v: PredictorValues, blocks: Blocks, starts: FloatArray, ends: FloatArray, weight: FloatArray
    ) -> tuple[FloatArray, FloatArray]:
        """Return the gradient by the adjoint: less work than a pass with sensitivities.

        ``w`` are the weighted errors, and ``a[k]`` is the derivative of the cost by the state at sample k. The adjoint
        runs backwards, ``a[k] = F' a[k+1] - C' w[k]``, from the multipliers at the end of a window. Derivatives by the
        entries of F and G are sums of products of ``a`` with states and regressors. Those by C and H use ``w``.
        """
        powers = powers_of(v.F, blocks.length)
        _, back = self._backwards(v, blocks, starts, ends, weight, powers[-1])
        return _by_parameters(v, back.sums), back.start[:, blocks.window_first].T

    def left_out(
        self,
        v: PredictorValues,
        blocks: Blocks,
        starts: FloatArray,
        ends: FloatArray,
        weight: FloatArray,
        moved: Sequence[Moved],
    ) -> tuple[FloatArray, FloatArray]:
        """Return what Gauss-Newton omits, from two passes for all columns together; see `Kernel`.

        With the adjoint a, the weighted errors w and the sensitivities ``s_j`` of the state, it is the sum over k of

            a[k+1]' (dF_i s_j + dF_j s_i + d2F_ij x + d2G_ij z) - w' (dC_i s_j + dC_j s_i + d2C_ij x + d2H_ij z).

        The sums of products of a and w with states and sensitivities come from the passes. Second derivatives of the
        matrices are differences of the first ones, which need no pass. The state is linear in the start of its window.
        So by a parameter and a start, ``dF_j F^k`` is all that is left.
        """
        powers, n, n_p = powers_of(v.F, blocks.length), len(v.F), len(v.dF)
        prediction, back = self._backwards(v, blocks, starts, ends, weight, powers[-1])
        second = self.run.second(v, blocks, prediction.states, back.factors)
        linked = link(blocks, second.end_theta, powers)
        live, m = slice(0, blocks.n_blocks), back.factors.shape[2]
        # Of the start of each block: products of the factors with the free response, (n_blocks, m * n, n).
        by_block = np.moveaxis(back.factors, -1, 1).transpose(0, 1, 3, 2).reshape(-1, blocks.length)
        free = (by_block @ powers[:-1].reshape(blocks.length, -1)).reshape(-1, m * n, n)[live]
        products = second.products.transpose(1, 0, 2).reshape(n_p, m * n)
        products = products + np.tensordot(linked.by_theta[live], free, ([0, 1], [0, 2]))
        slopes = np.concatenate([v.dF, v.dC], axis=1).reshape(n_p, m * n)
        across = slopes @ products.T
        full, wanted = across + across.T, [own.column for own in moved]
        theta, mixed = np.zeros((n_p, n_p)), np.zeros((blocks.n_windows, n_p, n))
        here = _by_parameters(v, back.sums)
        for own in moved:
            change = (_by_parameters(own.v, back.sums) - here) / own.step
            theta[:, own.column] = full[:, own.column] + change
        by_start = np.add.reduceat((slopes @ free) @ linked.by_start[live], blocks.window_first)
        mixed[:, wanted] = by_start[:, wanted]
        return theta, mixed

    def _backwards(
        self,
        v: PredictorValues,
        blocks: Blocks,
        starts: FloatArray,
        ends: FloatArray,
        weight: FloatArray,
        transition: FloatArray,
    ) -> tuple[Prediction, Adjoint]:
        """Run the model forwards and its adjoint backwards through the blocks of each window."""
        prediction = self.run.predict(v, blocks, starts_of_blocks(v, blocks, starts, transition, self.run))
        weighted = weight @ prediction.errors * blocks.used[:, :, None]
        at_end = np.zeros((len(v.F), len(blocks.size)))
        at_end[:, blocks.window_first + blocks.window_size - 1] = ends.T
        back = self.run.adjoint(v, blocks, weighted, prediction.states, at_end)
        if blocks.per_window > 1:
            at_start = _back_along_windows(blocks, back.start, transition)
            at_end[:, blocks.followed] = at_start[:, blocks.followed + 1]
            back = self.run.adjoint(v, blocks, weighted, prediction.states, at_end)
        return prediction, back

    def growth(
        self,
        v: PredictorValues,
        blocks: Blocks,  # noqa: ARG002
        sweep: Sweep | None,  # noqa: ARG002
        state_scale: FloatArray,  # noqa: ARG002
    ) -> float:
        """Return the spectral radius; see `Kernel`."""
        return spectral_radius([v])

    def feedback(
        self,
        v: PredictorValues,
        blocks: Blocks,  # noqa: ARG002
        prediction: Prediction,  # noqa: ARG002
    ) -> PredictorValues:
        """Return the predictor itself; see `Kernel`."""
        return v

    def sensitivities(
        self, v: PredictorValues, blocks: Blocks, prediction: Prediction, linked: Linked, own: slice
    ) -> FloatArray:
        """Return the sensitivities of some blocks; see `Kernel`."""
        first = np.concatenate([linked.by_theta[own], linked.by_start[own]], axis=2)
        return self.run.sensitivities(v, blocks, prediction, first, own)


def _back_along_windows(blocks: Blocks, own: FloatArray, transition: FloatArray) -> FloatArray:
    """Return the adjoint at the start of every block, (n, W), from the adjoints of single blocks."""
    backwards = blocks.window_size[:, None] - 1 - np.arange(blocks.per_window)
    inside = backwards >= 0
    blocks_of = blocks.window_first[:, None] + np.maximum(backwards, 0)
    result = np.zeros_like(own)
    result[:, blocks_of[inside]] = scan(transition.T, own[:, blocks_of][..., None])[:, inside, 0]
    return result


def _by_parameters(v: PredictorValues, sums: FloatArray) -> FloatArray:
    """Return derivatives by the predictor's parameters from those by the entries of its matrices."""
    n, n_p = len(v.F), len(v.dF)
    pairs = ((v.dF, sums[:n, :n]), (v.dG, sums[:n, n:]), (v.dC, sums[n:, :n]), (v.dH, sums[n:, n:]))
    return np.asarray(sum(slopes.reshape(n_p, -1) @ own.ravel() for slopes, own in pairs))
