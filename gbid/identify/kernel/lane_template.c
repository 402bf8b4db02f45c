/* Written by gbid for one nonlinear structure: see gbid/identify/kernel/lanes.py. */
@VECTORS@
typedef long long mask __attribute__((vector_size(8*WIDTH)));
static inline v all(double a) { return (v){0} + a; }
static inline v kept(v a, mask live) { return (v)((mask)a & live); }
static inline v one(mask is) { return kept(all(1.0), is); }
@FUNCTIONS@
#define N @N@
#define NP @NP@
#define NC (NP + N)
#define NM @NM@
#define NZ @NZ@
#define NY @NY@
#define NQ @NQ@
#define FEEDS @FEEDS@
#define PAD TILED(NC + 1) /* columns of the derivatives, then the error */
#define ROWS AT_LEAST_4(BUFFER/(PAD*NY*sizeof(v)))
#define BUF (ROWS*NY)
@PRODUCTS@

/* Parameters, the part of a sample that is one step, and what depends on them alone. */
typedef struct {
  v theta[NP], known[NQ], part;
  long steps;
  v of_output[output_size], of_step[step_size], of_output_jacobian[output_jacobian_size];
  v of_step_jacobian[step_jacobian_size];
} point;

static void point_at(point *p, const v *theta, const double *known, long steps) {
  for (int i = 0; i < NP; i++) p->theta[i] = theta[i];
  for (int i = 0; i < NQ; i++) p->known[i] = all(known[i]);
  p->steps = steps;
  p->part = all(1.0/steps);
  output_once(p->theta, p->known, p->of_output);
  step_once(p->theta, p->known, &p->part, p->of_step);
  output_jacobian_once(p->theta, p->known, p->of_output_jacobian);
  step_jacobian_once(p->theta, p->known, &p->part, p->of_step_jacobian);
}

static void point_of(point *p, const double *theta, const double *known, long steps) {
  v same[NP];
  for (int i = 0; i < NP; i++) same[i] = all(theta[i]);
  point_at(p, same, known, steps);
}

/* State after a sample; x is overwritten. */
static void onwards(const point *p, v *restrict x, const v *restrict z, v *restrict yhat) {
  v xe[N], e[NY];
  output(x, z, p->theta, p->known, p->of_output, xe, yhat, e);
  for (long s = 0; s < p->steps; s++) {
    v t = all((double)s/p->steps), next[N];
    step(xe, z, e, p->theta, p->known, &t, &p->part, p->of_step, next);
    for (int c = 0; c < N; c++) xe[c] = next[c];
  }
  for (int c = 0; c < N; c++) x[c] = xe[c];
}

/* Jacobians of some steps by [x, e, theta], in columns: of the first step, of all up to one, and of one by [e, theta].
   Entries that are always zero are never written. */
typedef struct { v first[N*NM], upto[2][N*NM], own[N*(NM - N)]; } jacobians;

/* The same with derivatives S, and those of the outputs.

   The Jacobians of the whole sample come first: they do not grow with the columns of S. */
static void onwards_with_slopes(const point *p, jacobians *J, v *restrict x, v *restrict S, const v *restrict z,
                                v *restrict yhat, v *restrict psi) {
  v xe[N], e[NY], X[N*NP], C[NY*N], D[NY*NP], F[N*N], next[N], *M = J->first;
  output_jacobian(x, z, p->theta, p->known, p->of_output_jacobian, xe, yhat, e, X, C, D);
  add_start(X, S);
  put_output(D, psi);
  for (int c = 0; c < NC; c++) add_output(C, S + c*N, psi + c*NY);
  for (long s = 0; s < p->steps; s++) {
    v t = all((double)s/p->steps), *T = J->upto[s%2];
    step_jacobian(xe, z, e, p->theta, p->known, &t, &p->part, p->of_step_jacobian, next, F, s ? J->own : M + N*N);
    for (int c = 0; c < N; c++) xe[c] = next[c];
    if (s == 0) put_first(F, M);
    else {
      step_states(F, M, M, T);
      step_rest(F, M + N*N, J->own, T + N*N);
      M = T;
    }
  }
#if FEEDS
  feed(C, D, M + N*N, M, M + (NM - NP)*N);
#endif
  sample_rest(M, S, M + (NM - NP)*N, S);
  sample_states(M, S + N*NP, M, S + N*NP);
  for (int c = 0; c < N; c++) x[c] = xe[c];
}

static void sum_up(int rows, const v *restrict P, v *restrict H) {
  for (int i = 0; i < PAD; i += TILE)
    for (int j = i; j < PAD; j += TILE) {
      v a[TILE][TILE];
      for (int p = 0; p < TILE; p++) for (int q = 0; q < TILE; q++) a[p][q] = H[(i + p)*PAD + j + q];
      for (int t = 0; t < rows; t++) {
        v l[TILE], r[TILE];
        for (int p = 0; p < TILE; p++) l[p] = P[(i + p)*BUF + t];
        for (int q = 0; q < TILE; q++) r[q] = P[(j + q)*BUF + t];
        for (int p = 0; p < TILE; p++) for (int q = 0; q < TILE; q++) a[p][q] += l[p]*r[q];
      }
      for (int p = 0; p < TILE; p++) for (int q = 0; q < TILE; q++) H[(i + p)*PAD + j + q] = a[p][q];
    }
}

typedef struct { v P[PAD*BUF], H[PAD*PAD], Ht[NP*NP]; jacobians J; } workspace;

/* The workspace is handed over: its address would be looked up again and again within the loops. */
static void __attribute__((noinline)) sums_with(
    workspace *w, long groups, long length, long steps, const double *theta, const double *known, const double *R,
    const u *zs, const u *ys, const u *used, const long long *size, const u *starts,
    double *hessian, double *products, u *gradient, u *mixed, u *by_start, u *end, u *slopes) {
  v *restrict const P = w->P, *restrict const E = P + NC*BUF, *restrict const H = w->H;
  v ee[NY*NY];
  point p;
  point_of(&p, theta, known, steps);
  for (int i = 0; i < PAD*BUF; i++) P[i] = all(0.0);
  for (int i = 0; i < NP*NP; i++) w->Ht[i] = all(0.0);
  for (int i = 0; i < NY*NY; i++) ee[i] = all(0.0);
  for (long h = 0; h < groups*PARTS; h++) {
    const long b = h/PARTS, part = h%PARTS;
    v x[N], S[N*NC];
    const long long *count = size + h*WIDTH;
    int ragged = 0, weighted = 0, t = 0;
    for (int l = 0; l < WIDTH; l++) ragged |= count[l] != length;
    for (long k = 0; k < length; k++) for (int l = 0; l < WIDTH; l++) weighted |= used[AT(b*length + k)][l] != 1;
    for (int c = 0; c < N; c++) x[c] = starts[AT(b*N + c)];
    for (int i = 0; i < N*NC; i++) S[i] = all(i >= N*NP && (i - N*NP)%(N + 1) == 0 ? 1.0 : 0.0);
    for (int i = 0; i < PAD*PAD; i++) H[i] = all(0.0);
    if (ragged) {
      for (int c = 0; c < N; c++) end[AT(b*N + c)] = x[c];
      for (int i = 0; i < N*NC; i++) slopes[AT(b*N*NC + i)] = S[i];
    }
    for (long k = 0; k < length; k++) {
      v z[NZ], yhat[NY], psi[NY*NC], e[NY];
      const v m = used[AT(b*length + k)];
      const mask live = m != 0.0;
      for (int i = 0; i < NZ; i++) z[i] = zs[AT((b*length + k)*NZ + i)];
      onwards_with_slopes(&p, &w->J, x, S, z, yhat, psi);
      for (int j = 0; j < NY; j++)
        e[j] = kept((ys[AT((b*length + k)*NY + j)] - yhat[j])*m, live);
      if (weighted) for (int i = 0; i < NY*NC; i++) psi[i] = kept(psi[i]*m, live);
      for (int a = 0; a < NY; a++) {
        v sum = all(0.0);
        for (int j = a; j < NY; j++) sum += R[a*NY + j]*e[j];
        E[t*NY + a] = sum;
        for (int j = a; j < NY; j++) ee[a*NY + j] += e[a]*e[j];
        for (int i = 0; i < NC; i++) {
          v own = R[a*NY + a]*psi[i*NY + a];
          for (int j = a + 1; j < NY; j++) own += R[a*NY + j]*psi[i*NY + j];
          P[i*BUF + t*NY + a] = own;
        }
      }
      if (ragged)
        for (int l = 0; l < WIDTH; l++)
          if (count[l] == k + 1) {
            for (int c = 0; c < N; c++) end[AT(b*N + c)][l] = x[c][l];
            for (int i = 0; i < N*NC; i++) slopes[AT(b*N*NC + i)][l] = S[i][l];
          }
      if (++t == ROWS || k + 1 == length) {
        sum_up(t*NY, P, H);
        t = 0;
      }
    }
    if (!ragged) {
      for (int c = 0; c < N; c++) end[AT(b*N + c)] = x[c];
      for (int i = 0; i < N*NC; i++) slopes[AT(b*N*NC + i)] = S[i];
    }
    for (int i = 0; i < NP; i++) {
      for (int j = i; j < NP; j++) w->Ht[i*NP + j] += H[i*PAD + j];
      for (int j = 0; j < N; j++) mixed[AT((b*NP + i)*N + j)] = H[i*PAD + NP + j];
    }
    for (int i = 0; i < N; i++)
      for (int j = i; j < N; j++)
        by_start[AT((b*N + i)*N + j)] = by_start[AT((b*N + j)*N + i)] = H[(NP + i)*PAD + NP + j];
    for (int i = 0; i < NC; i++) gradient[AT(b*NC + i)] = -H[i*PAD + NC];
  }
  for (int i = 0; i < NP; i++)
    for (int j = i; j < NP; j++) hessian[i*NP + j] = hessian[j*NP + i] = total(w->Ht[i*NP + j]);
  for (int a = 0; a < NY; a++)
    for (int c = a; c < NY; c++) products[a*NY + c] = products[c*NY + a] = total(ee[a*NY + c]);
}

@WORKSPACE@

/* Sums of the Gauss-Newton problem; arrays as for SampleSums, the eight blocks of a group innermost. */
void gbid_sums(long groups, long length, long steps, const double *theta, const double *known, const double *R,
               const u *zs, const u *ys, const u *used, const long long *size, const u *starts,
               double *hessian, double *products, u *gradient, u *mixed, u *by_start, u *end,
               u *slopes) {
  sums_with(workspace_of_thread(), groups, length, steps, theta, known, R, zs, ys, used, size, starts, hessian,
            products, gradient, mixed, by_start, end, slopes);
}

/* States, errors, and the products of errors of each block, from given starts. Without `states` the products alone. */
void gbid_passed(long groups, long length, long steps, const double *theta, const double *known, const u *zs,
                 const u *ys, const u *used, const u *starts, u *states, u *errors,
                 u *end, u *products) {
  point p;
  point_of(&p, theta, known, steps);
  for (long h = 0; h < groups*PARTS; h++) {
    const long b = h/PARTS, part = h%PARTS;
    v x[N], yhat[NY], z[NZ], e[NY], ee[NY*NY];
    for (int c = 0; c < N; c++) x[c] = starts[AT(b*N + c)];
    for (int i = 0; i < NY*NY; i++) ee[i] = all(0.0);
    for (long k = 0; k < length; k++) {
      const v m = used[AT(b*length + k)];
      for (int i = 0; i < NZ; i++) z[i] = zs[AT((b*length + k)*NZ + i)];
      if (states) for (int c = 0; c < N; c++) states[AT((b*length + k)*N + c)] = x[c];
      onwards(&p, x, z, yhat);
      for (int j = 0; j < NY; j++) e[j] = kept((ys[AT((b*length + k)*NY + j)] - yhat[j])*m, m != 0.0);
      for (int a = 0; a < NY; a++) for (int c = 0; c < NY; c++) ee[a*NY + c] += e[a]*e[c];
      if (errors) for (int j = 0; j < NY; j++) errors[AT((b*length + k)*NY + j)] = e[j];
    }
    if (end) for (int c = 0; c < N; c++) end[AT(b*N + c)] = x[c];
    for (int i = 0; i < NY*NY; i++) products[AT(b*NY*NY + i)] = ee[i];
  }
}

/* Derivatives of the outputs, sample by sample, from given states and derivatives at the starts. */
void gbid_psi(long groups, long length, long steps, const double *theta, const double *known, const u *zs,
              const u *starts, const u *first, u *slopes) {
  jacobians *J = &workspace_of_thread()->J;
  point p;
  point_of(&p, theta, known, steps);
  for (long h = 0; h < groups*PARTS; h++) {
    const long b = h/PARTS, part = h%PARTS;
    v x[N], S[N*NC], yhat[NY], z[NZ], psi[NY*NC];
    for (int c = 0; c < N; c++) x[c] = starts[AT(b*N + c)];
    for (int i = 0; i < N*NC; i++) S[i] = first[AT(b*N*NC + i)];
    for (long k = 0; k < length; k++) {
      for (int i = 0; i < NZ; i++) z[i] = zs[AT((b*length + k)*NZ + i)];
      onwards_with_slopes(&p, J, x, S, z, yhat, psi);
      for (int i = 0; i < NY*NC; i++) slopes[AT((b*length + k)*NY*NC + i)] = psi[i];
    }
  }
}

static long block_of(const long long *first, const long long *count, long window, long windows, long i) {
  const long w = window < windows ? window : windows - 1;
  return first[w] + (i < count[w] ? i : count[w] - 1);
}

/* States at the starts of the blocks of windows, a window in each lane. Each window has parameters of its own, and a
   row of the result to which its blocks are added. */
void gbid_begin(long windows, long length, long steps, const double *theta, const double *known, const double *zs,
                const long long *first, const long long *count, const long long *row, const double *starts,
                double *begin) {
  for (long w = 0; w < windows; w += WIDTH) {
    v x[N], yhat[NY], z[NZ], own_theta[NP];
    point p;
    for (int i = 0; i < NP; i++)
      for (int l = 0; l < WIDTH; l++) own_theta[i][l] = theta[(w + l < windows ? w + l : windows - 1)*NP + i];
    point_at(&p, own_theta, known, steps);
    long most = 0;
    for (int l = 0; l < WIDTH; l++) {
      const long own = w + l < windows ? w + l : windows - 1;
      if (w + l < windows && count[own] > most) most = count[own];
      for (int c = 0; c < N; c++) x[c][l] = starts[own*N + c];
    }
    for (long i = 0; i < most; i++) {
      long at[WIDTH];
      for (int l = 0; l < WIDTH; l++) {
        at[l] = block_of(first, count, w + l, windows, i);
        if (w + l < windows && i < count[w + l])
          for (int c = 0; c < N; c++) begin[(row[w + l] + at[l])*N + c] = x[c][l];
      }
      if (i + 1 == most) break;
      for (long k = 0; k < length; k++) {
        for (int j = 0; j < NZ; j++)
          for (int l = 0; l < WIDTH; l++) z[j][l] = zs[((at[l]/LANES*length + k)*NZ + j)*LANES + at[l]%LANES];
        onwards(&p, x, z, yhat);
      }
    }
  }
}
