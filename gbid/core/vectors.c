/* Blocks stand in groups of LANES, side by side in memory. A vector has WIDTH of them, as many as a register of the
   target: wider vectors of GCC live in memory. A group takes PARTS turns, in which `part` is set. The accumulators of
   TILE by TILE sums stay in the 16 registers of x86-64, or the 32 of AVX-512 and aarch64. */
#define LANES 8
#ifndef WIDTH
#if defined __AVX512F__
#define WIDTH 8
#elif defined __AVX__
#define WIDTH 4
#else
#define WIDTH 2
#endif
#endif
#if defined __AVX512F__ || defined __aarch64__
#define TILE 4
#else
#define TILE 3
#endif
#define BUFFER 32768 /* bytes of factors that are held between sums: they stay in the first-level cache */
#define PARTS (LANES/WIDTH)
#define AT(row) ((row)*PARTS + part)
#define TILED(size) (((size) + TILE - 1)/TILE*TILE)
#define AT_LEAST_4(count) ((count) > 4 ? (count) : 4)
typedef double v __attribute__((vector_size(8*WIDTH)));
typedef double u __attribute__((vector_size(8*WIDTH), aligned(8)));
static inline double total(v a) {
  double s = 0;
  for (int l = 0; l < WIDTH; l++) s += a[l];
  return s;
}
