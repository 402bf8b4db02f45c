/* Written by gbid for one model structure: see gbid/identify/kernel/linear.py. */
@VECTORS@
#define N @N@
#define NZ @NZ@
#define NY @NY@
#define NP @NP@
#define NPP @NPP@
#define NT @NT@
#define BUF (@STEPS@*NY)
#define TILE @TILE@

/* Sums over the samples of one buffer, whose row after those of the parameters is the error. U are the roots of their
   weights, or NULL where all are 1 or 0: P has one root already, T has none. */
static void add_up(int rows, v *restrict P, const double *restrict T, const v *restrict U, v *restrict H,
                   v *restrict M) {
  for (int i = 0; i < NPP; i += TILE)
    for (int j = i; j < NPP; j += TILE) {
      v a[TILE][TILE];
      for (int p = 0; p < TILE; p++) for (int q = 0; q < TILE; q++) a[p][q] = H[(i + p)*NPP + j + q];
      for (int t = 0; t < rows; t++) {
        v l[TILE], r[TILE];
        for (int p = 0; p < TILE; p++) l[p] = P[(i + p)*BUF + t];
        for (int q = 0; q < TILE; q++) r[q] = P[(j + q)*BUF + t];
        for (int p = 0; p < TILE; p++) for (int q = 0; q < TILE; q++) a[p][q] += l[p]*r[q];
      }
      for (int p = 0; p < TILE; p++) for (int q = 0; q < TILE; q++) H[(i + p)*NPP + j + q] = a[p][q];
    }
  if (U) for (int i = 0; i <= NP; i++) for (int t = 0; t < rows; t++) P[i*BUF + t] *= U[t];
  for (int i = 0; i < NPP; i += TILE)
    for (int c = 0; c < NT; c += TILE) {
      v a[TILE][TILE];
      for (int p = 0; p < TILE; p++) for (int q = 0; q < TILE; q++) a[p][q] = M[(i + p)*NT + c + q];
      for (int t = 0; t < rows; t++) {
        v l[TILE];
        for (int p = 0; p < TILE; p++) l[p] = P[(i + p)*BUF + t];
        for (int q = 0; q < TILE; q++) for (int p = 0; p < TILE; p++) a[p][q] += l[p]*T[t*NT + c + q];
      }
      for (int p = 0; p < TILE; p++) for (int q = 0; q < TILE; q++) M[(i + p)*NT + c + q] = a[p][q];
    }
}

typedef struct { v P[NPP*BUF], U[BUF], hs[NPP*NPP], M[NPP*NT], S[NP*N]; } workspace;

/* Arrays as documented for BlockSums, the eight blocks of a group innermost; T has NT columns. The workspace is handed
   over: its address would be looked up again and again within the loops. */
static void __attribute__((noinline)) pass_with(
    workspace *w, long groups, long length, const double *restrict F, const double *restrict G,
    const double *restrict C, const double *restrict H, const double *restrict dF, const double *restrict dG,
    const double *restrict dC, const double *restrict dH, const double *restrict R, const double *restrict T,
    const double *restrict zs, const double *restrict ys, const double *restrict used, const long long *restrict size,
    const double *restrict starts, double *restrict hessian, double *restrict products, double *restrict gradient,
    double *restrict gradient_start, double *restrict mixed, double *restrict end, double *restrict end_theta) {
  const v zero = {0};
  v *restrict const P = w->P, *restrict const E = P + NP*BUF, *restrict const U = w->U, *restrict const hs = w->hs,
    *restrict const M = w->M, *restrict const S = w->S;
  v ee[NY*NY];
  for (int i = 0; i < NPP*BUF; i++) P[i] = zero;
  for (int i = 0; i < NPP*NPP; i++) hs[i] = zero;
  for (int i = 0; i < NY*NY; i++) ee[i] = zero;
  for (long b = 0; b < groups; b++) {
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
    for (long k = 0; k < length; k++) {
      const u *z = (const u *)(zs + (b*length + k)*NZ*8);
      const u *y = (const u *)(ys + (b*length + k)*NY*8);
      const v m = *(const u *)(used + (b*length + k)*8);
@STEP@
      if (weighted) for (int j = 0; j < NY; j++) U[t*NY + j] = m;
      for (int c = 0; c < N; c++) x[c] = nx[c];
      for (int l = 0; ragged && l < 8; l++) {
        if (count[l] != k + 1) continue;
        for (int c = 0; c < N; c++) end_b[c*8 + l] = x[c][l];
        for (int i = 0; i < NP*N; i++) end_theta_b[i*8 + l] = S[i][l];
      }
      if (++t == BUF/NY || k + 1 == length) {
        add_up(t*NY, P, T + (k + 1 - t)*NY*NT, weighted ? U : 0, hs, M);
        t = 0;
      }
    }
    if (!ragged) {
      for (int c = 0; c < N; c++) *(u *)(end_b + c*8) = x[c];
      for (int i = 0; i < NP*N; i++) *(u *)(end_theta_b + i*8) = S[i];
    }
    for (int i = 0; i < NP; i++) for (int c = 0; c < N; c++) *(u *)(mixed + ((b*NP + i)*N + c)*8) = M[i*NT + c];
    for (int i = 0; i < NP; i++) *(u *)(gradient + (b*NP + i)*8) = -hs[i*NPP + NP];
    for (int c = 0; c < N; c++) *(u *)(gradient_start + (b*N + c)*8) = -M[NP*NT + c];
  }
  for (int i = 0; i < NP; i++)
    for (int j = i; j < NP; j++) hessian[i*NP + j] = hessian[j*NP + i] = total(hs[i*NPP + j]);
  for (int a = 0; a < NY; a++)
    for (int c = a; c < NY; c++) products[a*NY + c] = products[c*NY + a] = total(ee[a*NY + c]);
}

@WORKSPACE@

void gbid_pass(long groups, long length, const double *F, const double *G, const double *C, const double *H,
               const double *dF, const double *dG, const double *dC, const double *dH, const double *R, const double *T,
               const double *zs, const double *ys, const double *used, const long long *size, const double *starts,
               double *h, double *products, double *g, double *gx, double *m, double *end, double *end_theta) {
  pass_with(workspace_of_thread(), groups, length, F, G, C, H, dF, dG, dC, dH, R, T, zs, ys, used, size, starts, h,
            products, g, gx, m, end, end_theta);
}

/* States, errors, and the products of errors of each block, from given starts. Without `states` the products alone. */
void gbid_predict(long groups, long length,
                  const double *restrict F, const double *restrict G, const double *restrict C,
                  const double *restrict H, const double *restrict zs, const double *restrict ys,
                  const double *restrict used, const double *restrict starts,
                  double *restrict states, double *restrict errors, double *restrict end, double *restrict products) {
  const v zero = {0};
  for (long b = 0; b < groups; b++) {
    v x[N], nx[N], e[NY], ee[NY*NY];
    for (int c = 0; c < N; c++) x[c] = *(const u *)(starts + (b*N + c)*8);
    for (int i = 0; i < NY*NY; i++) ee[i] = zero;
    for (long k = 0; k < length; k++) {
      const u *z = (const u *)(zs + (b*length + k)*NZ*8);
      const u *y = (const u *)(ys + (b*length + k)*NY*8);
      const v m = *(const u *)(used + (b*length + k)*8);
@PREDICT@
      if (states) for (int c = 0; c < N; c++) *(u *)(states + ((b*length + k)*N + c)*8) = x[c];
      if (errors) for (int j = 0; j < NY; j++) *(u *)(errors + ((b*length + k)*NY + j)*8) = e[j];
      for (int i = 0; i < NY; i++) for (int j = 0; j < NY; j++) ee[i*NY + j] += e[i]*e[j];
      for (int c = 0; c < N; c++) x[c] = nx[c];
    }
    if (end) for (int c = 0; c < N; c++) *(u *)(end + (b*N + c)*8) = x[c];
    for (int i = 0; i < NY*NY; i++) *(u *)(products + (b*NY*NY + i)*8) = ee[i];
  }
}

/* Adjoint of the cost, backwards from its value at the end of each block; and sums of its products with states and
   regressors, rows those of F and G, then those of C and H. */
void gbid_adjoint(long groups, long length, const double *restrict F, const double *restrict C,
                  const double *restrict weighted, const double *restrict states, const double *restrict zs,
                  const long long *restrict size, const double *restrict last,
                  double *restrict first, double *restrict factors, double *restrict sums) {
  const v zero = {0};
  v S[N + NY][N + NZ];
  for (int i = 0; i < N + NY; i++) for (int j = 0; j < N + NZ; j++) S[i][j] = zero;
  for (long b = 0; b < groups; b++) {
    v a[N], na[N];
    for (int c = 0; c < N; c++) a[c] = zero;
    for (long k = length - 1; k >= 0; k--) {
      const u *x = (const u *)(states + (b*length + k)*N*8);
      const u *z = (const u *)(zs + (b*length + k)*NZ*8);
      const u *w = (const u *)(weighted + (b*length + k)*NY*8);
      for (int l = 0; l < 8; l++)
        if (size[8*b + l] == k + 1)
          for (int c = 0; c < N; c++) a[c][l] = last[(b*N + c)*8 + l];
      u *f = (u *)(factors + (b*length + k)*(N + NY)*8);
      for (int c = 0; c < N; c++) f[c] = a[c];
      for (int j = 0; j < NY; j++) f[N + j] = -w[j];
      for (int i = 0; i < N; i++) {
        for (int j = 0; j < N; j++) S[i][j] += a[i]*x[j];
        for (int j = 0; j < NZ; j++) S[i][N + j] += a[i]*z[j];
      }
      for (int i = 0; i < NY; i++) {
        for (int j = 0; j < N; j++) S[N + i][j] -= w[i]*x[j];
        for (int j = 0; j < NZ; j++) S[N + i][N + j] -= w[i]*z[j];
      }
@BACK@
      for (int c = 0; c < N; c++) a[c] = na[c];
    }
    for (int c = 0; c < N; c++) *(u *)(first + (b*N + c)*8) = a[c];
  }
  for (int i = 0; i < N + NY; i++) for (int j = 0; j < N + NZ; j++) sums[i*(N + NZ) + j] = total(S[i][j]);
}
