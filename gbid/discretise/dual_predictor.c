/* Exponentials and predictors with their derivatives, by the formulas of exact.py and predictor.py: a parameter in each
   lane of a vector. */
@VECTORS@
#define ORDER 15
#define BLOCK 4

/* An entry of a matrix, and its derivatives. */
typedef struct { double value; u slope; } number;

static inline number times(number a, number b) {
  return (number){a.value*b.value, a.slope*b.value + a.value*b.slope};
}

/* a + factor b */
static inline number plus(number a, double factor, number b) {
  return (number){a.value + factor*b.value, a.slope + factor*b.slope};
}

static void multiply(long rows, long inner, long columns, const number *a, const number *b, number *out) {
  for (long i = 0; i < rows; i++)
    for (long k = 0; k < columns; k++) {
      number sum = {0};
      for (long j = 0; j < inner; j++) sum = plus(sum, 1, times(a[i*inner + j], b[j*columns + k]));
      out[i*columns + k] = sum;
    }
}

/* out = p a + q out */
static void combine(long count, double p, const number *a, double q, number *out) {
  for (long i = 0; i < count; i++) out[i] = (number){p*a[i].value + q*out[i].value, p*a[i].slope + q*out[i].slope};
}

static void add_identity(long n, double factor, number *out) {
  for (long i = 0; i < n; i++) out[i*(n + 1)].value += factor;
}

/* Room for nine matrices: powers, results, and one on the way. */
typedef struct { number *power[BLOCK + 1], *exp, *phi1, *phi2, *side; } exponentials;

static exponentials exponentials_in(long n, number *room) {
  exponentials e = {.exp = room, .phi1 = room + n*n, .phi2 = room + 2*n*n, .side = room + 3*n*n};
  for (long k = 0; k <= BLOCK; k++) e.power[k] = room + (4 + k)*n*n;
  return e;
}

static void swap(number **a, number **b) {
  number *last = *a;
  *a = *b, *b = last;
}

/* From Z in power[1]. */
static void exponentiate(long n, long doublings, exponentials *e) {
  const long m = n*n;
  double weights[ORDER + 1] = {0.5}, part = 1;
  for (long k = 1; k <= ORDER; k++) weights[k] = weights[k - 1]/(k + 2);
  for (long s = 0; s < doublings; s++) part /= 2;
  for (long i = 0; i < m; i++) e->power[1][i] = plus((number){0}, part, e->power[1][i]), e->phi2[i] = (number){0};
  for (long k = 2; k <= BLOCK; k++) multiply(n, n, n, e->power[k - 1], e->power[1], e->power[k]);
  for (long first = ORDER + 1 - BLOCK; first >= 0; first -= BLOCK) {
    multiply(n, n, n, e->power[BLOCK], e->phi2, e->side), swap(&e->phi2, &e->side);
    for (long k = 1; k < BLOCK; k++) combine(m, weights[first + k], e->power[k], 1, e->phi2);
    add_identity(n, weights[first], e->phi2);
  }
  multiply(n, n, n, e->power[1], e->phi2, e->phi1), add_identity(n, 1, e->phi1);
  multiply(n, n, n, e->power[1], e->phi1, e->exp), add_identity(n, 1, e->exp);
  for (; doublings > 0; doublings--) {
    multiply(n, n, n, e->phi1, e->phi1, e->side), combine(m, 0.25, e->side, 0.5, e->phi2);
    multiply(n, n, n, e->exp, e->phi1, e->side), combine(m, 0.5, e->side, 0.5, e->phi1);
    multiply(n, n, n, e->exp, e->exp, e->side), swap(&e->exp, &e->side);
  }
}

/* Parameters by which any of so many entries has a derivative; those of one parameter follow after `stride`. */
static long moving(long n_p, long count, const double *slopes, long stride, long *which) {
  long n_moving = 0;
  for (long j = 0, i; j < n_p; j++) {
    for (i = 0; i < count && slopes[j*stride + i] == 0; i++) {}
    if (i < count) which[n_moving++] = j;
  }
  return n_moving;
}

static void load(long count, const double *values, const double *slopes, long stride, const long *which, long lanes,
                 number *out) {
  for (long i = 0; i < count; i++) {
    out[i] = (number){values[i]};
    for (long l = 0; l < lanes; l++) out[i].slope[l] = slopes[which[l]*stride + i];
  }
}

static void store(long count, const number *in, double *values, double *slopes, long stride, const long *which,
                  long lanes) {
  for (long i = 0; i < count; i++) {
    values[i] = in[i].value;
    for (long l = 0; l < lanes; l++) slopes[which[l]*stride + i] = in[i].slope[l];
  }
}

/* Z is (points, n, n), dZ (n_p, points, n, n), room 81 n^2; the results are (3, points, n, n) and
   (3, n_p, points, n, n). Parameters that do not move Z at a point have no derivatives there, and take no time. */
void gbid_exponentials(long points, long n, long n_p, long doublings, const double *Z, const double *dZ, double *room,
                       double *results, double *slopes) {
  const long m = n*n, all = points*m;
  for (long p = 0; p < points; p++) {
    long which[n_p + 1], count = moving(n_p, m, dZ + p*m, all, which);
    for (long first = 0; first == 0 || first < count; first += WIDTH) {
      const long lanes = count - first < WIDTH ? count - first : WIDTH;
      exponentials e = exponentials_in(n, (number *)room);
      load(m, Z + p*m, dZ + p*m, all, which + first, lanes, e.power[1]);
      exponentiate(n, doublings, &e);
      const number *out[3] = {e.exp, e.phi1, e.phi2};
      for (long k = 0; k < 3; k++)
        store(m, out[k], results + k*all + p*m, slopes + k*n_p*all + p*m, all, which + first, lanes);
    }
  }
}

/* [F G] of a predictor: (points, n, columns) and (n_p, points, n, columns), both zero before.

   Each point has `width` numbers, by each parameter, too: A, the columns that act at once (prompt inputs and n_error
   of errors), those of delayed inputs, delays, x0, C, and the n_feed columns of the outputs before those of errors.
   `spans` are the sample time [s] and the whole samples of each delay; `foh` says which prompt and delayed inputs are
   on straight lines. Columns of F, prompt inputs, their next samples, delayed inputs, disturbances, impulse, errors. */
void gbid_predictor(long points, long n, long n_prompt, long n_error, long n_late, long n_feed, long columns,
                    long impulse, long n_p, long width, long doublings, const double *spans, const long long *foh,
                    const double *values, const double *jacobian, double *room, double *result, double *slopes) {
  const double h = spans[0], *shift = spans + 1;
  const long m = n_prompt + n_error, size = n*columns, all = points*size;
  number *Z = (number *)room + 9*n*n, *held = Z + n*n, *ramp = held + n*m, *late1 = ramp + n*m,
         *late2 = late1 + n*n_late, *after1 = late2 + n*n_late, *after2 = after1 + n, *b = after2 + n, *R = b + n,
         *in = R + size;
  const number *A = in, *B = A + n*n, *late = B + n*m, *delay = late + n*n_late, *x0 = delay + n_late, *C = x0 + n,
               *feed = C + n_error*n, one = {1};
  for (long p = 0; p < points; p++) {
    long which[n_p + 1], count = moving(n_p, width, jacobian + p*n_p*width, width, which);
    for (long first = 0; first == 0 || first < count; first += WIDTH) {
      const long lanes = count - first < WIDTH ? count - first : WIDTH;
      exponentials e = exponentials_in(n, (number *)room);
      load(width, values + p*width, jacobian + p*n_p*width, width, which + first, lanes, in);
      for (long i = 0; i < n*n; i++) e.power[1][i] = Z[i] = plus((number){0}, h, A[i]);
      for (long i = 0; i < size; i++) R[i] = (number){0};
      exponentiate(n, doublings, &e);
      multiply(n, n, m, e.phi1, B, held), multiply(n, n, m, e.phi2, B, ramp);
      multiply(n, n, n_late, e.phi1, late, late1), multiply(n, n, n_late, e.phi2, late, late2);
      long next = n + n_prompt;
      for (long i = 0; i < n; i++) for (long k = 0; k < n; k++) R[i*columns + k] = e.exp[i*n + k];
      for (long k = 0; k < m; k++) {
        const long to = k < n_prompt ? n + k : columns - m + k, straight = k < n_prompt && foh[k];
        for (long i = 0; i < n; i++) {
          R[i*columns + to] = plus((number){0}, h, plus(held[i*m + k], -straight, ramp[i*m + k]));
          if (straight) R[i*columns + next] = plus((number){0}, h, ramp[i*m + k]);
        }
        next += straight;
      }
      for (long j = 0; j < n_late; j++) {
        const long straight = foh[n_prompt + j];
        const number early = plus((number){-shift[j]}, 1/h, delay[j]), rest = plus(one, -1, early);
        for (long i = 0; i < n*n; i++) e.power[1][i] = times(Z[i], rest);
        for (long i = 0; i < n; i++) b[i] = late[i*n_late + j];
        exponentiate(n, doublings, &e);
        multiply(n, n, 1, e.phi1, b, after1), multiply(n, n, 1, e.phi2, b, after2);
        for (long i = 0; i < n; i++) {
          const number none = {0}, held_after = plus(none, h, times(after1[i], rest)),
                       held_before = plus(plus(none, h, late1[i*n_late + j]), -1, held_after),
                       rise_after = plus(none, h, times(times(after2[i], rest), rest)),
                       over = plus(plus(none, h, late2[i*n_late + j]), -1, rise_after),
                       rise_before = plus(plus(over, -1, times(held_after, early)), 1, times(held_before, rest));
          number *to = R + i*columns + next;
          if (straight) *to++ = rise_after;
          *to++ = straight ? plus(plus(held_after, -1, rise_after), 1, rise_before) : held_after;
          *to = straight ? plus(held_before, -1, rise_before) : held_before;
        }
        next += 2 + straight;
      }
      for (long i = 0; i < n; i++) {
        number *row = R + i*columns;
        for (long q = 0; q < n_error; q++) {
          const number gain = row[columns - n_error + q];
          for (long k = 0; k < n; k++) row[k] = plus(row[k], -1, times(gain, C[q*n + k]));
          for (long k = 0; k < n_feed; k++) row[n + k] = plus(row[n + k], -1, times(gain, feed[q*n_feed + k]));
        }
        if (impulse) multiply(1, n, 1, row, x0, row + n + n_feed);
      }
      store(size, R, result + p*size, slopes + p*size, all, which + first, lanes);
    }
  }
}
