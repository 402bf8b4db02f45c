/* Written by gbid for one model structure: see gbid/identify/kernel/linear.py. */
@VECTORS@
#define N @N@
#define NZ @NZ@
#define NY @NY@
#define NP @NP@
#define ROWS TILED(N + NY)
#define COLUMNS TILED(NP*N)
#define STEPS AT_LEAST_4(BUFFER/((ROWS + COLUMNS)*sizeof(v)))

/* Products over the samples of one buffer. */
static void add_up(int count, const v *restrict A, const v *restrict S, v *restrict P) {
  for (int i = 0; i < ROWS; i += TILE)
    for (int j = 0; j < COLUMNS; j += TILE) {
      v a[TILE][TILE];
      for (int p = 0; p < TILE; p++) for (int q = 0; q < TILE; q++) a[p][q] = P[(i + p)*COLUMNS + j + q];
      for (int t = 0; t < count; t++) {
        v l[TILE], r[TILE];
        for (int p = 0; p < TILE; p++) l[p] = A[t*ROWS + i + p];
        for (int q = 0; q < TILE; q++) r[q] = S[t*COLUMNS + j + q];
        for (int p = 0; p < TILE; p++) for (int q = 0; q < TILE; q++) a[p][q] += l[p]*r[q];
      }
      for (int p = 0; p < TILE; p++) for (int q = 0; q < TILE; q++) P[(i + p)*COLUMNS + j + q] = a[p][q];
    }
}

typedef struct { v A[STEPS*ROWS], S[(STEPS + 1)*COLUMNS], P[ROWS*COLUMNS]; } workspace;

@WORKSPACE@

/* GCC compiles the long code of the next function five times faster at -O1, and it then runs as fast. */
#if defined __GNUC__ && !defined __clang__
__attribute__((optimize("O1")))
#endif
/* Arrays as documented for CompiledLinearKernel.second_pass, the eight blocks of a group innermost. */
void gbid_second(long groups, long length, const double *restrict F, const double *restrict dF,
                 const double *restrict dG, const u *restrict states, const u *restrict zs,
                 const u *restrict factors, double *restrict products, u *restrict end_theta) {
  const v zero = {0};
  workspace *w = workspace_of_thread();
  v *restrict const A = w->A, *restrict const S = w->S, *restrict const P = w->P;
  (void)dG;
  for (int i = 0; i < ROWS*COLUMNS; i++) P[i] = zero;
  for (int i = 0; i < STEPS*ROWS; i++) A[i] = zero;
  for (int i = 0; i < (STEPS + 1)*COLUMNS; i++) S[i] = zero;
  for (long h = 0; h < groups*PARTS; h++) {
    const long b = h/PARTS, part = h%PARTS;
    int t = 0;
    for (int i = 0; i < COLUMNS; i++) S[i] = zero;
    for (long k = 0; k < length; k++) {
      v x[N], z[NZ];
      for (int c = 0; c < N; c++) x[c] = states[AT((b*length + k)*N + c)];
      for (int j = 0; j < NZ; j++) z[j] = zs[AT((b*length + k)*NZ + j)];
      const v *restrict before = S + t*COLUMNS;
      v *restrict next = S + (t + 1)*COLUMNS;
      for (int i = 0; i < N + NY; i++) A[t*ROWS + i] = factors[AT((b*length + k)*(N + NY) + i)];
@STEP@
      if (++t == STEPS || k + 1 == length) {
        add_up(t, A, S, P);
        for (int i = 0; i < COLUMNS; i++) S[i] = S[t*COLUMNS + i];
        t = 0;
      }
    }
    for (int i = 0; i < NP*N; i++) end_theta[AT(b*NP*N + i)] = S[i];
  }
  for (int i = 0; i < N + NY; i++)
    for (int j = 0; j < NP*N; j++) products[i*NP*N + j] = total(P[i*COLUMNS + j]);
}
