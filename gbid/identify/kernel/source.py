"""C source of the pass over the samples, for one size and one pattern of nonzeros.

Eight blocks run side by side in the lanes of a vector type. The recursion of states and sensitivities is
written out entry by entry, zeros left out; the sums over the samples are small matrix products on a buffer of
a few steps, so that their accumulators stay in registers.
"""

from __future__ import annotations

import numpy as np

from gbid.arrays import BoolArray
from gbid.identify.kernel.kernel_pattern import KernelPattern

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
/* Written by gbid for one model structure: see gbid/identify/kernel/source.py. */
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
