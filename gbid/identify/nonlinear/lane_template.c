/* Written by gbid for one nonlinear structure: see gbid/identify/nonlinear/lanes.py. */
@TYPES@
@FUNCTIONS@
#define N @N@
#define NP @NP@
#define NC (NP + N)
#define NM @NM@
#define NZ @NZ@
#define NY @NY@
#define NQ @NQ@
#define FEEDS @FEEDS@
#define ROWS @ROWS@
#define BUF (ROWS*NY)
#define TILE 4
#define PAD (((NC + TILE - 1)/TILE)*TILE)
#define MOST 256
@PRODUCTS@

static inline double total(v a) {
  double s = 0;
  for (int l = 0; l < 8; l++) s += a[l];
  return s;
}

typedef struct { v theta[NP], known[NQ]; long steps; v part; } point;

static void point_of(point *p, const double *theta, const double *known, long steps) {
  for (int i = 0; i < NP; i++) p->theta[i] = all(theta[i]);
  for (int i = 0; i < NQ; i++) p->known[i] = all(known[i]);
  p->steps = steps;
  p->part = all(1.0/steps);
}

/* State after a sample; x is overwritten. */
static void onwards(const point *p, v *restrict x, const v *restrict z, v *restrict yhat) {
  v xe[N], e[NY];
  output(x, z, p->theta, p->known, xe, yhat, e);
  for (long s = 0; s < p->steps; s++) {
    v t = all((double)s/p->steps), next[N];
    step(xe, z, e, p->theta, p->known, &t, &p->part, next);
    for (int c = 0; c < N; c++) xe[c] = next[c];
  }
  for (int c = 0; c < N; c++) x[c] = xe[c];
}

/* The same with derivatives S, and those of the outputs.

   The Jacobians M of the whole sample by [x, e, theta] come first: they do not grow with the columns of S. */
static void onwards_with_slopes(const point *p, v *restrict x, v *restrict S, const v *restrict z, v *restrict yhat,
                                v *restrict psi) {
  v xe[N], e[NY], X[N*NP], C[NY*N], D[NY*NP], both[2][N*NM], none[N];
  v *restrict M = both[0], *restrict T = both[1];
  for (int i = 0; i < N; i++) none[i] = all(0.0);
  output_jacobian(x, z, p->theta, p->known, xe, yhat, e, X, C, D);
  add_start(X, S);
  put_output(D, psi);
  for (int c = 0; c < NC; c++) add_output(C, S + c*N, psi + c*NY);
  for (long s = 0; s < p->steps; s++) {
    v t = all((double)s/p->steps), next[N], F[N*N], G[N*(NM - N)], *swap = M;
    step_jacobian(xe, z, e, p->theta, p->known, &t, &p->part, next, F, G);
    for (int c = 0; c < N; c++) xe[c] = next[c];
    put_own(G, T + N*N);
    if (s == 0) put_step(F, T);
    else {
      for (int c = 0; c < N; c++) add_step(F, M + c*N, none, T + c*N);
      for (int c = N; c < NM; c++) add_step(F, M + c*N, T + c*N, T + c*N);
    }
    M = T;
    T = swap;
  }
  if (FEEDS) feed(C, D, M + N*N, M, M + (NM - NP)*N);
  for (int c = 0; c < NP; c++) add_sample(M, S + c*N, M + (NM - NP + c)*N, S + c*N);
  for (int c = NP; c < NC; c++) add_sample(M, S + c*N, none, S + c*N);
  for (int c = 0; c < N; c++) x[c] = xe[c];
}

static void sum_up(int rows, const v *restrict P, const v *restrict E, v *restrict H, v *restrict g) {
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
  for (int i = 0; i < NC; i++)
    for (int t = 0; t < rows; t++) g[i] += P[i*BUF + t]*E[t];
}

/* Sums of the Gauss-Newton problem; arrays as for SampleSums, the eight blocks of a group innermost. */
void gbid_sums(long groups, long length, long steps, const double *theta, const double *known, const double *R,
               const double *zs, const double *ys, const double *used, const long long *size, const double *starts,
               double *hessian, double *products, double *gradient, double *mixed, double *by_start, double *end,
               double *slopes) {
  static __thread v buffer[PAD*BUF + BUF + PAD*PAD + NP*NP];
  v *restrict const P = buffer, *restrict const E = P + PAD*BUF, *restrict const H = E + BUF, *restrict const Ht = H + PAD*PAD;
  v ee[NY*NY];
  point p;
  point_of(&p, theta, known, steps);
  for (int i = 0; i < PAD*BUF; i++) P[i] = all(0.0);
  for (int i = 0; i < NP*NP; i++) Ht[i] = all(0.0);
  for (int i = 0; i < NY*NY; i++) ee[i] = all(0.0);
  for (long b = 0; b < groups; b++) {
    v x[N], S[N*NC], g[NC];
    const long long *count = size + 8*b;
    for (int c = 0; c < N; c++) x[c] = *(const u *)(starts + (b*N + c)*8);
    for (int i = 0; i < N*NC; i++) S[i] = all(i >= N*NP && (i - N*NP)%(N + 1) == 0 ? 1.0 : 0.0);
    for (int i = 0; i < NC; i++) g[i] = all(0.0);
    for (int i = 0; i < PAD*PAD; i++) H[i] = all(0.0);
    for (int c = 0; c < N; c++) *(u *)(end + (b*N + c)*8) = x[c];
    for (int i = 0; i < N*NC; i++) *(u *)(slopes + (b*N*NC + i)*8) = S[i];
    int t = 0;
    for (long k = 0; k < length; k++) {
      v z[NZ], yhat[NY], psi[NY*NC], e[NY];
      const v m = *(const u *)(used + (b*length + k)*8);
      const m8 live = m != 0.0;
      for (int i = 0; i < NZ; i++) z[i] = *(const u *)(zs + ((b*length + k)*NZ + i)*8);
      onwards_with_slopes(&p, x, S, z, yhat, psi);
      for (int j = 0; j < NY; j++)
        e[j] = kept((*(const u *)(ys + ((b*length + k)*NY + j)*8) - yhat[j])*m, live);
      for (int i = 0; i < NY*NC; i++) psi[i] = kept(psi[i]*m, live);
      for (int a = 0; a < NY; a++) {
        v sum = all(0.0);
        for (int j = a; j < NY; j++) sum += R[a*NY + j]*e[j];
        E[t*NY + a] = sum;
        for (int j = a; j < NY; j++) ee[a*NY + j] += e[a]*e[j];
        for (int i = 0; i < NC; i++) {
          v own = all(0.0);
          for (int j = a; j < NY; j++) own += R[a*NY + j]*psi[i*NY + j];
          P[i*BUF + t*NY + a] = own;
        }
      }
      for (int l = 0; l < 8; l++)
        if (count[l] == k + 1) {
          for (int c = 0; c < N; c++) end[(b*N + c)*8 + l] = x[c][l];
          for (int i = 0; i < N*NC; i++) slopes[(b*N*NC + i)*8 + l] = S[i][l];
        }
      if (++t == ROWS || k + 1 == length) {
        sum_up(t*NY, P, E, H, g);
        t = 0;
      }
    }
    for (int i = 0; i < NP; i++) {
      for (int j = i; j < NP; j++) Ht[i*NP + j] += H[i*PAD + j];
      for (int j = 0; j < N; j++) *(u *)(mixed + ((b*NP + i)*N + j)*8) = H[i*PAD + NP + j];
    }
    for (int i = 0; i < N; i++)
      for (int j = i; j < N; j++)
        *(u *)(by_start + ((b*N + i)*N + j)*8) = *(u *)(by_start + ((b*N + j)*N + i)*8) = H[(NP + i)*PAD + NP + j];
    for (int i = 0; i < NC; i++) *(u *)(gradient + (b*NC + i)*8) = -g[i];
  }
  for (int i = 0; i < NP; i++)
    for (int j = i; j < NP; j++) hessian[i*NP + j] = hessian[j*NP + i] = total(Ht[i*NP + j]);
  for (int a = 0; a < NY; a++)
    for (int c = a; c < NY; c++) products[a*NY + c] = products[c*NY + a] = total(ee[a*NY + c]);
}

/* States, errors, and the products of errors of each block, from given starts. Without `states` the products alone. */
void gbid_passed(long groups, long length, long steps, const double *theta, const double *known, const double *zs,
                 const double *ys, const double *used, const double *starts, double *states, double *errors,
                 double *end, double *products) {
  point p;
  point_of(&p, theta, known, steps);
  for (long b = 0; b < groups; b++) {
    v x[N], yhat[NY], z[NZ], e[NY], ee[NY*NY];
    for (int c = 0; c < N; c++) x[c] = *(const u *)(starts + (b*N + c)*8);
    for (int i = 0; i < NY*NY; i++) ee[i] = all(0.0);
    for (long k = 0; k < length; k++) {
      const v m = *(const u *)(used + (b*length + k)*8);
      for (int i = 0; i < NZ; i++) z[i] = *(const u *)(zs + ((b*length + k)*NZ + i)*8);
      if (states) for (int c = 0; c < N; c++) *(u *)(states + ((b*length + k)*N + c)*8) = x[c];
      onwards(&p, x, z, yhat);
      for (int j = 0; j < NY; j++) e[j] = kept((*(const u *)(ys + ((b*length + k)*NY + j)*8) - yhat[j])*m, m != 0.0);
      for (int a = 0; a < NY; a++) for (int c = 0; c < NY; c++) ee[a*NY + c] += e[a]*e[c];
      if (states) for (int j = 0; j < NY; j++) *(u *)(errors + ((b*length + k)*NY + j)*8) = e[j];
    }
    if (states) for (int c = 0; c < N; c++) *(u *)(end + (b*N + c)*8) = x[c];
    for (int i = 0; i < NY*NY; i++) *(u *)(products + (b*NY*NY + i)*8) = ee[i];
  }
}

/* Derivatives of the outputs, sample by sample, from given states and derivatives at the starts. */
void gbid_psi(long groups, long length, long steps, const double *theta, const double *known, const double *zs,
              const double *starts, const double *first, double *slopes) {
  point p;
  point_of(&p, theta, known, steps);
  for (long b = 0; b < groups; b++) {
    v x[N], S[N*NC], yhat[NY], z[NZ], psi[NY*NC];
    for (int c = 0; c < N; c++) x[c] = *(const u *)(starts + (b*N + c)*8);
    for (int i = 0; i < N*NC; i++) S[i] = *(const u *)(first + (b*N*NC + i)*8);
    for (long k = 0; k < length; k++) {
      for (int i = 0; i < NZ; i++) z[i] = *(const u *)(zs + ((b*length + k)*NZ + i)*8);
      onwards_with_slopes(&p, x, S, z, yhat, psi);
      for (int i = 0; i < NY*NC; i++) *(u *)(slopes + ((b*length + k)*NY*NC + i)*8) = psi[i];
    }
  }
}

static long block_of(const long long *first, const long long *count, long window, long windows, long i) {
  const long w = window < windows ? window : windows - 1;
  return first[w] + (i < count[w] ? i : count[w] - 1);
}

/* States at the starts of the blocks of windows, eight windows at a time. */
void gbid_begin(long windows, long length, long steps, const double *theta, const double *known, const double *zs,
                const long long *first, const long long *count, const double *starts, double *begin) {
  point p;
  point_of(&p, theta, known, steps);
  for (long w = 0; w < windows; w += 8) {
    v x[N], yhat[NY], z[NZ];
    long most = 0;
    for (int l = 0; l < 8; l++) {
      const long own = w + l < windows ? w + l : windows - 1;
      if (w + l < windows && count[own] > most) most = count[own];
      for (int c = 0; c < N; c++) x[c][l] = starts[own*N + c];
    }
    for (long i = 0; i < most; i++) {
      long at[8];
      for (int l = 0; l < 8; l++) {
        at[l] = block_of(first, count, w + l, windows, i);
        if (w + l < windows && i < count[w + l])
          for (int c = 0; c < N; c++) begin[at[l]*N + c] = x[c][l];
      }
      if (i + 1 == most) break;
      for (long k = 0; k < length; k++) {
        for (int j = 0; j < NZ; j++)
          for (int l = 0; l < 8; l++) z[j][l] = zs[(((at[l]/8)*length + k)*NZ + j)*8 + at[l]%8];
        onwards(&p, x, z, yhat);
      }
    }
  }
}

/* Adjoint of the cost, backwards from its value at the ends of the windows. */
void gbid_adjoint(long windows, long length, long steps, const double *theta, const double *known, const double *zs,
                  const double *states, const double *weighted, const long long *size, const long long *first,
                  const long long *count, const double *ends, double *by_theta, double *starts) {
  static __thread v passed[MOST + 1][N];
  v sum[NP];
  point p;
  point_of(&p, theta, known, steps);
  for (int i = 0; i < NP; i++) sum[i] = all(0.0);
  for (long w = 0; w < windows; w += 8) {
    v a[N];
    long most = 0;
    for (int l = 0; l < 8; l++) {
      const long own = w + l < windows ? w + l : windows - 1;
      if (w + l < windows && count[own] > most) most = count[own];
      for (int c = 0; c < N; c++) a[c][l] = ends[own*N + c];
    }
    for (long i = most - 1; i >= 0; i--) {
      long at[8];
      for (int l = 0; l < 8; l++) at[l] = block_of(first, count, w + l, windows, i);
      for (long k = length - 1; k >= 0; k--) {
        v x[N], z[NZ], e[NY], yhat[NY], onto[NY], by_error[NY], own[NP], back[N], more[NP], be[NY];
        m8 live = {0};
        long any = 0;
        for (int l = 0; l < 8; l++) {
          const int counts = w + l < windows && i < count[w + l] && k < size[at[l]];
          live[l] = counts ? -1 : 0;
          any |= counts;
          const long row = (at[l]/8)*length + k, lane = at[l]%8;
          for (int c = 0; c < N; c++) x[c][l] = states[(row*N + c)*8 + lane];
          for (int c = 0; c < NZ; c++) z[c][l] = zs[(row*NZ + c)*8 + lane];
          for (int c = 0; c < NY; c++) onto[c][l] = -weighted[(row*NY + c)*8 + lane];
        }
        if (!any) continue;
        output(x, z, p.theta, p.known, passed[0], yhat, e);
        for (long s = 0; s + 1 < p.steps; s++) {
          v t = all((double)s/p.steps);
          step(passed[s], z, e, p.theta, p.known, &t, &p.part, passed[s + 1]);
        }
        for (int c = 0; c < N; c++) back[c] = a[c];
        for (int c = 0; c < NY; c++) by_error[c] = all(0.0);
        for (int c = 0; c < NP; c++) own[c] = all(0.0);
        for (long s = p.steps - 1; s >= 0; s--) {
          v t = all((double)s/p.steps), before[N];
          step_back(passed[s], z, e, p.theta, p.known, &t, &p.part, back, before, be, more);
          for (int c = 0; c < N; c++) back[c] = before[c];
          for (int c = 0; c < NY; c++) by_error[c] += be[c];
          for (int c = 0; c < NP; c++) own[c] += more[c];
        }
        if (FEEDS) for (int c = 0; c < NY; c++) onto[c] -= by_error[c];
        v before[N];
        output_back(x, z, p.theta, p.known, back, onto, before, more);
        for (int c = 0; c < N; c++) a[c] = kept(before[c], live) + kept(a[c], ~live);
        for (int c = 0; c < NP; c++) sum[c] += kept(own[c] + more[c], live);
      }
    }
    for (int l = 0; l < 8; l++)
      if (w + l < windows)
        for (int c = 0; c < N; c++) starts[(w + l)*N + c] = a[c][l];
  }
  for (int c = 0; c < NP; c++) by_theta[c] = total(sum[c]);
}
