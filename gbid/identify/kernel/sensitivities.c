/* Sensitivities of the predictions of a linear predictor, sample by sample, for any sizes. */
@VECTORS@
#define CHUNK 8

/* Rows of a matrix without its zeros: entries of row r are those from row[r] to row[r + 1]. */
typedef struct { const long long *row, *column; const double *value; } sparse;

static inline v times(const sparse *A, long r, const v *x, v sum) {
  for (long long e = A->row[r]; e < A->row[r + 1]; e++) sum += A->value[e]*x[A->column[e]];
  return sum;
}

/* The recursion s_i[k+1] = F s_i[k] + D_i w[k], psi_i[k] = C s_i[k] + E_i w[k] with w = [x, z], from given s_i[0].

   Rows of D and E are those of all parameters one after the other. The columns of the start follow those of the
   parameters, and have no D and E. `sides` is room for 2*m*n + n + n_z + m*n_y*CHUNK vectors. */
void gbid_sensitivities(long n, long n_p, long n_y, long n_z, long length, long first, long stop,
                        const long long *F_row, const long long *F_column, const double *F_value,
                        const long long *C_row, const long long *C_column, const double *C_value,
                        const long long *D_row, const long long *D_column, const double *D_value,
                        const long long *E_row, const long long *E_column, const double *E_value,
                        const u *states, const u *zs, const u *used, const double *starts,
                        double *sides, double *psi) {
  const sparse F = {F_row, F_column, F_value}, C = {C_row, C_column, C_value}, D = {D_row, D_column, D_value},
               E = {E_row, E_column, E_value};
  const long m = n_p + n, count = stop - first;
  v *S = (v *)sides, *next = S + m*n, *w = next + m*n, *Q = w + n + n_z;
  const v zero = {0};
  for (long h = first/WIDTH; h < (stop + WIDTH - 1)/WIDTH; h++) {
    const long g = h/PARTS, part = h%PARTS;
    for (long l = 0; l < WIDTH; l++) {
      const long b = h*WIDTH + l - first;
      for (long i = 0; i < m*n; i++) S[i][l] = b >= 0 && b < count ? starts[b*m*n + i] : 0;
    }
    for (long k = 0; k < length; k++) {
      const v used_k = used[AT(g*length + k)];
      for (long c = 0; c < n; c++) w[c] = states[AT((g*length + k)*n + c)];
      for (long c = 0; c < n_z; c++) w[n + c] = zs[AT((g*length + k)*n_z + c)];
      for (long i = 0; i < m; i++) {
        const v *s = S + i*n;
        for (long j = 0; j < n_y; j++) {
          const v own = i < n_p ? times(&E, i*n_y + j, w, zero) : zero;
          Q[(j*m + i)*CHUNK + k%CHUNK] = times(&C, j, s, own)*used_k;
        }
        for (long c = 0; c < n; c++) next[i*n + c] = times(&F, c, s, i < n_p ? times(&D, i*n + c, w, zero) : zero);
      }
      v *swap = S; S = next; next = swap;
      if ((k + 1)%CHUNK == 0 || k + 1 == length)
        for (long r = 0; r < n_y*m; r++)
          for (long l = 0; l < WIDTH; l++) {
            const long b = h*WIDTH + l - first, begin = k - k%CHUNK;
            if (b >= 0 && b < count)
              for (long t = begin; t <= k; t++) psi[(r*count + b)*length + t] = Q[r*CHUNK + t - begin][l];
          }
    }
  }
}
