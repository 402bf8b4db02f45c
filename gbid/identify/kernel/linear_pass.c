/* Written by gbid for one model structure: see gbid/identify/kernel/linear.py. */
@VECTORS@
#define N @N@
#define NZ @NZ@
#define NY @NY@
#define NP @NP@
#define NT @NT@
#define NPP TILED(NP + 1)
#define STEPS AT_LEAST_4(BUFFER/(NPP*NY*sizeof(v)))
#define BUF (STEPS*NY)

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
    for (int c = 0; c < NT; c += 4) {
      v a[TILE][4];
      for (int p = 0; p < TILE; p++) for (int q = 0; q < 4; q++) a[p][q] = M[(i + p)*NT + c + q];
      for (int t = 0; t < rows; t++) {
        v l[TILE];
        for (int p = 0; p < TILE; p++) l[p] = P[(i + p)*BUF + t];
        for (int q = 0; q < 4; q++) for (int p = 0; p < TILE; p++) a[p][q] += l[p]*T[t*NT + c + q];
      }
      for (int p = 0; p < TILE; p++) for (int q = 0; q < 4; q++) M[(i + p)*NT + c + q] = a[p][q];
    }
}

typedef struct { v P[NPP*BUF], U[BUF], hs[NPP*NPP], M[NPP*NT], S[NP*N]; } workspace;

/* Arrays as documented for BlockSums, the eight blocks of a group innermost; T has NT columns. The workspace is handed
   over: its address would be looked up again and again within the loops. */
static void __attribute__((noinline)) pass_with(
    workspace *w, long groups, long length, const double *restrict F, const double *restrict G,
    const double *restrict C, const double *restrict H, const double *restrict dF, const double *restrict dG,
    const double *restrict dC, const double *restrict dH, const double *restrict R, const double *restrict T,
    const u *restrict zs, const u *restrict ys, const u *restrict used, const long long *restrict size,
    const u *restrict starts, double *restrict hessian, double *restrict products, u *restrict gradient,
    u *restrict gradient_start, u *restrict mixed, u *restrict end, u *restrict end_theta) {
  const v zero = {0};
  v *restrict const P = w->P, *restrict const E = P + NP*BUF, *restrict const U = w->U, *restrict const hs = w->hs,
    *restrict const M = w->M, *restrict const S = w->S;
  v ee[NY*NY];
  for (int i = 0; i < NPP*BUF; i++) P[i] = zero;
  for (int i = 0; i < NPP*NPP; i++) hs[i] = zero;
  for (int i = 0; i < NY*NY; i++) ee[i] = zero;
  for (long h = 0; h < groups*PARTS; h++) {
    const long b = h/PARTS, part = h%PARTS;
    v x[N], nx[N], e[NY];
    for (int i = 0; i < NPP; i++) hs[i*NPP + NP] = zero; /* the gradient is that of a block */
    for (int i = 0; i < NPP*NT; i++) M[i] = zero;
    const long long *count = size + h*WIDTH;
    int ragged = 0, weighted = 0, t = 0;
    for (int l = 0; l < WIDTH; l++) ragged |= count[l] != length;
    for (long k = 0; k < length; k++)
      for (int l = 0; l < WIDTH; l++) weighted |= used[AT(b*length + k)][l] != 0 && used[AT(b*length + k)][l] != 1;
    for (int c = 0; c < N; c++) x[c] = starts[AT(b*N + c)];
    for (int i = 0; i < NP*N; i++) S[i] = zero;
    if (ragged) for (int c = 0; c < N; c++) end[AT(b*N + c)] = x[c];
    for (long k = 0; k < length; k++) {
      v z[NZ], y[NY];
      for (int j = 0; j < NZ; j++) z[j] = zs[AT((b*length + k)*NZ + j)];
      for (int j = 0; j < NY; j++) y[j] = ys[AT((b*length + k)*NY + j)];
      const v m = used[AT(b*length + k)];
@STEP@
      if (weighted) for (int j = 0; j < NY; j++) U[t*NY + j] = m;
      for (int c = 0; c < N; c++) x[c] = nx[c];
      for (int l = 0; ragged && l < WIDTH; l++) {
        if (count[l] != k + 1) continue;
        for (int c = 0; c < N; c++) end[AT(b*N + c)][l] = x[c][l];
        for (int i = 0; i < NP*N; i++) end_theta[AT(b*NP*N + i)][l] = S[i][l];
      }
      if (++t == BUF/NY || k + 1 == length) {
        add_up(t*NY, P, T + (k + 1 - t)*NY*NT, weighted ? U : 0, hs, M);
        t = 0;
      }
    }
    if (!ragged) {
      for (int c = 0; c < N; c++) end[AT(b*N + c)] = x[c];
      for (int i = 0; i < NP*N; i++) end_theta[AT(b*NP*N + i)] = S[i];
    }
    for (int i = 0; i < NP; i++) for (int c = 0; c < N; c++) mixed[AT((b*NP + i)*N + c)] = M[i*NT + c];
    for (int i = 0; i < NP; i++) gradient[AT(b*NP + i)] = -hs[i*NPP + NP];
    for (int c = 0; c < N; c++) gradient_start[AT(b*N + c)] = -M[NP*NT + c];
  }
  for (int i = 0; i < NP; i++)
    for (int j = i; j < NP; j++) hessian[i*NP + j] = hessian[j*NP + i] = total(hs[i*NPP + j]);
  for (int a = 0; a < NY; a++)
    for (int c = a; c < NY; c++) products[a*NY + c] = products[c*NY + a] = total(ee[a*NY + c]);
}

@WORKSPACE@

void gbid_pass(long groups, long length, const double *F, const double *G, const double *C, const double *H,
               const double *dF, const double *dG, const double *dC, const double *dH, const double *R, const double *T,
               const u *zs, const u *ys, const u *used, const long long *size, const u *starts,
               double *h, double *products, u *g, u *gx, u *m, u *end, u *end_theta) {
  pass_with(workspace_of_thread(), groups, length, F, G, C, H, dF, dG, dC, dH, R, T, zs, ys, used, size, starts, h,
            products, g, gx, m, end, end_theta);
}

/* States, errors, and the products of errors of each block, from given starts. Without `states` the products alone. */
void gbid_predict(long groups, long length,
                  const double *restrict F, const double *restrict G, const double *restrict C,
                  const double *restrict H, const u *restrict zs, const u *restrict ys,
                  const u *restrict used, const u *restrict starts,
                  u *restrict states, u *restrict errors, u *restrict end, u *restrict products) {
  const v zero = {0};
  for (long h = 0; h < groups*PARTS; h++) {
    const long b = h/PARTS, part = h%PARTS;
    v x[N], nx[N], e[NY], ee[NY*NY];
    for (int c = 0; c < N; c++) x[c] = starts[AT(b*N + c)];
    for (int i = 0; i < NY*NY; i++) ee[i] = zero;
    for (long k = 0; k < length; k++) {
      v z[NZ], y[NY];
      for (int j = 0; j < NZ; j++) z[j] = zs[AT((b*length + k)*NZ + j)];
      for (int j = 0; j < NY; j++) y[j] = ys[AT((b*length + k)*NY + j)];
      const v m = used[AT(b*length + k)];
@PREDICT@
      if (states) for (int c = 0; c < N; c++) states[AT((b*length + k)*N + c)] = x[c];
      if (errors) for (int j = 0; j < NY; j++) errors[AT((b*length + k)*NY + j)] = e[j];
      for (int i = 0; i < NY; i++) for (int j = 0; j < NY; j++) ee[i*NY + j] += e[i]*e[j];
      for (int c = 0; c < N; c++) x[c] = nx[c];
    }
    if (end) for (int c = 0; c < N; c++) end[AT(b*N + c)] = x[c];
    for (int i = 0; i < NY*NY; i++) products[AT(b*NY*NY + i)] = ee[i];
  }
}

/* Adjoint of the cost, backwards from its value at the end of each block; and sums of its products with states and
   regressors, rows those of F and G, then those of C and H. */
void gbid_adjoint(long groups, long length, const double *restrict F, const double *restrict C,
                  const u *restrict weighted, const u *restrict states, const u *restrict zs,
                  const long long *restrict size, const u *restrict last,
                  u *restrict first, u *restrict factors, double *restrict sums) {
  const v zero = {0};
  v S[N + NY][N + NZ];
  for (int i = 0; i < N + NY; i++) for (int j = 0; j < N + NZ; j++) S[i][j] = zero;
  for (long h = 0; h < groups*PARTS; h++) {
    const long b = h/PARTS, part = h%PARTS;
    v a[N], na[N];
    for (int c = 0; c < N; c++) a[c] = zero;
    for (long k = length - 1; k >= 0; k--) {
      v x[N], z[NZ], w[NY];
      for (int c = 0; c < N; c++) x[c] = states[AT((b*length + k)*N + c)];
      for (int j = 0; j < NZ; j++) z[j] = zs[AT((b*length + k)*NZ + j)];
      for (int j = 0; j < NY; j++) w[j] = weighted[AT((b*length + k)*NY + j)];
      for (int l = 0; l < WIDTH; l++)
        if (size[h*WIDTH + l] == k + 1)
          for (int c = 0; c < N; c++) a[c][l] = last[AT(b*N + c)][l];
      for (int c = 0; c < N; c++) factors[AT((b*length + k)*(N + NY) + c)] = a[c];
      for (int j = 0; j < NY; j++) factors[AT((b*length + k)*(N + NY) + N + j)] = -w[j];
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
    for (int c = 0; c < N; c++) first[AT(b*N + c)] = a[c];
  }
  for (int i = 0; i < N + NY; i++) for (int j = 0; j < N + NZ; j++) sums[i*(N + NZ) + j] = total(S[i][j]);
}
