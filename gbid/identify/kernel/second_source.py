"""C source of the second pass over the samples: products of the adjoint and the sensitivities of the states.

With the first pass (`gbid.identify.kernel.source`) it shares the lanes and the pattern of nonzeros. It is a library of
its own, because only fits with coloured errors need it.
"""

from __future__ import annotations

import numpy as np

from gbid.identify.kernel.kernel_pattern import KernelPattern
from gbid.identify.kernel.source import LANES, sum_of, terms_of

_BUFFER_BYTES = 96 * 1024  # factors of the products held between sums: stays in the first-level cache
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
    return _TEMPLATE.format(
        LANES=LANES,
        N=n,
        NZ=n_z,
        NY=n_y,
        NP=n_p,
        ROWS=rows,
        COLUMNS=columns,
        STEPS=max(4, _BUFFER_BYTES // ((rows + columns) * 64)),
        TILE=_TILE,
        STEP="\n".join("      " + line for i in range(n_p) for line in _sensitivity(pattern, i)),
    )


def _sensitivity(p: KernelPattern, i: int) -> list[str]:
    """Sensitivity of the state by one parameter after a sample, from that at it."""
    n, n_z = p.G.shape
    lines = []
    live = p.live(i)
    for r in np.flatnonzero(live):
        terms = [f"F[{r * n + c}]*s[{i * n + c}]" for c in np.flatnonzero(p.F[r] & live)]
        terms += terms_of(p.dF[i, r], "dF", (i * n + r) * n, "x") + terms_of(p.dG[i, r], "dG", (i * n + r) * n_z, "z")
        lines.append(f"next[{i * n + r}] = {sum_of(terms)};")
    return lines


_TEMPLATE = """\
/* Written by gbid for one model structure: see gbid/identify/kernel/second_source.py. */
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
