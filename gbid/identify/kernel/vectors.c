typedef double v __attribute__((vector_size(64)));
typedef double u __attribute__((vector_size(64), aligned(8)));
static inline double total(v a) {
  double s = 0;
  for (int l = 0; l < 8; l++) s += a[l];
  return s;
}
