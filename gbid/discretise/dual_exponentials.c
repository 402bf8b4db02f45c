/* e^Z, phi_1(Z) and phi_2(Z) of small matrices with their derivatives, by the algorithm of exact.py: eight parameters
   at a time, one in each lane. */
typedef double v __attribute__((vector_size(64), aligned(8)));
#define LANES 8
#define ORDER 15
#define BLOCK 4

/* A matrix, row by row, and the derivatives of its entries. */
typedef struct { double *value; v *slope; } dual;

static void multiply(long n, dual a, dual b, dual out) {
  for (long i = 0; i < n; i++)
    for (long k = 0; k < n; k++) {
      double value = 0;
      v slope = {0};
      for (long j = 0; j < n; j++) {
        value += a.value[i*n + j]*b.value[j*n + k];
        slope += a.slope[i*n + j]*b.value[j*n + k] + a.value[i*n + j]*b.slope[j*n + k];
      }
      out.value[i*n + k] = value, out.slope[i*n + k] = slope;
    }
}

/* out = p a + q out */
static void combine(long n, double p, dual a, double q, dual out) {
  for (long i = 0; i < n*n; i++) {
    out.value[i] = p*a.value[i] + q*out.value[i];
    out.slope[i] = p*a.slope[i] + q*out.slope[i];
  }
}

static void add_identity(long n, double factor, dual out) {
  for (long i = 0; i < n; i++) out.value[i*(n + 1)] += factor;
}

static void swap(dual *a, dual *b) {
  const dual last = *a;
  *a = *b, *b = last;
}

/* From Z in power[1]; all that is not yet written is zero. */
static void exponentials(long n, long doublings, dual *power, dual *exp, dual *phi1, dual *phi2, dual *side) {
  double weights[ORDER + 1] = {0.5};
  for (long k = 1; k <= ORDER; k++) weights[k] = weights[k - 1]/(k + 2);
  for (long k = 2; k <= BLOCK; k++) multiply(n, power[k - 1], power[1], power[k]);
  for (long first = ORDER + 1 - BLOCK; first >= 0; first -= BLOCK) {
    multiply(n, power[BLOCK], *phi2, *side), swap(phi2, side);
    for (long k = 1; k < BLOCK; k++) combine(n, weights[first + k], power[k], 1, *phi2);
    add_identity(n, weights[first], *phi2);
  }
  multiply(n, power[1], *phi2, *phi1), add_identity(n, 1, *phi1);
  multiply(n, power[1], *phi1, *exp), add_identity(n, 1, *exp);
  for (; doublings > 0; doublings--) {
    multiply(n, *phi1, *phi1, *side), combine(n, 0.25, *side, 0.5, *phi2);
    multiply(n, *exp, *phi1, *side), combine(n, 0.5, *side, 0.5, *phi1);
    multiply(n, *exp, *exp, *side), swap(exp, side);
  }
}

/* Z is (points, n, n), dZ (n_p, points, n, n), room 9 n^2 vectors and as many numbers; the results are (3, points, n, n)
   and (3, n_p, points, n, n). Parameters that do not move Z at a point have no derivatives there, and take no time. */
void gbid_exponentials(long points, long n, long n_p, long doublings, const double *Z, const double *dZ, double *room,
                       double *results, double *slopes) {
  const long m = n*n;
  double part = 1;
  for (long s = 0; s < doublings; s++) part /= 2;
  dual all[9];
  for (long k = 0; k < 9; k++) all[k].slope = (v *)room + k*m, all[k].value = room + 9*LANES*m + k*m;
  for (long p = 0; p < points; p++) {
    long moving[n_p + 1], n_moving = 0;
    for (long j = 0, i; j < n_p; j++) {
      for (i = 0; i < m && dZ[(j*points + p)*m + i] == 0; i++) {}
      if (i < m) moving[n_moving++] = j;
    }
    for (long first = 0; first == 0 || first < n_moving; first += LANES) {
      const long count = n_moving - first < LANES ? n_moving - first : LANES;
      for (long i = 0; i < 9*(LANES + 1)*m; i++) room[i] = 0;
      for (long i = 0; i < m; i++) {
        all[1].value[i] = part*Z[p*m + i];
        for (long l = 0; l < count; l++) all[1].slope[i][l] = part*dZ[(moving[first + l]*points + p)*m + i];
      }
      exponentials(n, doublings, all, all + 5, all + 6, all + 7, all + 8);
      for (long k = 0; k < 3; k++)
        for (long i = 0; i < m; i++) {
          results[(k*points + p)*m + i] = all[5 + k].value[i];
          for (long l = 0; l < count; l++)
            slopes[((k*n_p + moving[first + l])*points + p)*m + i] = all[5 + k].slope[i][l];
        }
    }
  }
}
