"""C source of the kernels of clusters of eigenvalues; it follows that of the Schur forms."""

from __future__ import annotations

CLUSTERS = r"""
/* Rotation of x and y: (c x + s y, c y - s* x), for numbers at some distance from one another. */
static void rotate(long count, num *x, num *y, long stride, double c, num s)
{
    for (long i = 0; i < count; i++, x += stride, y += stride) {
        num a = *x, b = *y;
        x->re = c * a.re + s.re * b.re - s.im * b.im, x->im = c * a.im + s.re * b.im + s.im * b.re;
        y->re = c * b.re - s.re * a.re - s.im * a.im, y->im = c * b.im - s.re * a.im + s.im * a.re;
    }
}

/* Rotation that turns (f, g) into (r, 0). */
static double rotation(num f, num g, num *s)
{
    double a = hypot(f.re, f.im), b = hypot(g.re, g.im), size = hypot(a, b);
    if (!(a > 0)) {
        *s = b > 0 ? (num){g.re / b, -g.im / b} : (num){0.0, 0.0};
        return b > 0 ? 0.0 : 1.0;
    }
    num turned = times((num){f.re / a, f.im / a}, (num){g.re, -g.im});
    *s = (num){turned.re / size, turned.im / size};
    return a / size;
}

/* Complex Schur form of the balanced matrix: form T, its vectors as rows (n, n), units of the states, and eigenvalues
   (n), of which those of a pair are exactly conjugate; 0: it fails. */
long schur_form(long n, const double *A, num *T)
{
    num *Z = T + n * n, *value = Z + n * n + (n + 1) / 2;
    double *unit = (double *)(Z + n * n);
    double *H = malloc((2 * n * n + 2 * n) * sizeof(double)), *Q = H ? H + n * n : 0;
    if (!H) return -1;
    memcpy(H, A, n * n * sizeof(double));
    balance(n, H, unit);
    to_hessenberg(n, H, Q, Q + n * n);
    long ended = francis(n, H, Q, value);
    for (long i = 0; ended && i < n * n; i++) {
        T[i] = (num){i / n > i % n + 1 ? 0.0 : H[i], 0.0};
        Z[i] = (num){Q[i], 0.0};
    }
    for (long m = n - 1; ended && m > 0; m--) {
        double below = H[m * n + m - 1];
        if (below == 0) continue;
        /* the first eigenvector of the block of two becomes its first basis vector */
        num s, off = {value[m - 1].re - H[m * n + m], value[m - 1].im};
        double c = rotation(off, (num){below, 0.0}, &s);
        num s_t = {s.re, -s.im};
        rotate(n - m + 1, T + (m - 1) * n + m - 1, T + m * n + m - 1, 1, c, s);
        rotate(m + 1, T + m - 1, T + m, n, c, s_t);
        rotate(n, Z + (m - 1) * n, Z + m * n, 1, c, s_t);
        T[m * n + m - 1] = (num){0.0, 0.0};
    }
    free(H);
    return ended;
}

/* Exchange of the eigenvalues k and k + 1 of a Schur form. */
static void exchange(long n, num *T, num *Z, long k)
{
    num first = T[k * n + k], second = T[(k + 1) * n + k + 1], s;
    double c = rotation(T[k * n + k + 1], (num){second.re - first.re, second.im - first.im}, &s);
    num s_t = {s.re, -s.im};
    if (k + 2 < n) rotate(n - k - 2, T + k * n + k + 2, T + (k + 1) * n + k + 2, 1, c, s);
    rotate(k, T + k, T + k + 1, n, c, s_t);
    rotate(n, Z + k * n, Z + (k + 1) * n, 1, c, s_t);
    T[k * n + k] = second, T[(k + 1) * n + k + 1] = first;
}

/* Solution X (k, n - k) of T11 X - X T22 = T12; returns its largest entry. */
static double coupling(long n, long k, const num *T, num *X)
{
    double largest = 0.0;
    for (long j = 0; j < n - k; j++)
        for (long i = k - 1; i >= 0; i--) {
            num sum = T[i * n + k + j], below = T[(k + j) * n + k + j];
            for (long l = 0; l < j; l++) {
                num t = times(X[i * (n - k) + l], T[(k + l) * n + k + j]);
                sum.re += t.re, sum.im += t.im;
            }
            for (long l = i + 1; l < k; l++) {
                num t = times(T[i * n + l], X[l * (n - k) + j]);
                sum.re -= t.re, sum.im -= t.im;
            }
            num x = over(sum, (num){T[i * n + i].re - below.re, T[i * n + i].im - below.im});
            X[i * (n - k) + j] = x;
            double size = fmax(fabs(x.re), fabs(x.im));
            largest = size <= largest ? largest : size;
        }
    return largest;
}

/* Product of k by k matrices. */
static void product(long k, const num *a, const num *b, num *out)
{
    for (long i = 0; i < k; i++)
        for (long j = 0; j < k; j++) {
            num sum = {0.0, 0.0};
            for (long l = 0; l < k; l++) {
                num t = times(a[i * k + l], b[l * k + j]);
                sum.re += t.re, sum.im += t.im;
            }
            out[i * k + j] = sum;
        }
}

/* Mean and power sums of the k eigenvalues of a Schur form nearest to a place, see `Cluster`: the k
   eigenvalues, mean, k - 1 sums, and the gradients (d) of each. Returns 0 when they are not apart from the others. */
long cluster(long n, long d, long k, const num *form, const double *dA, double re, double im, double rate,
             double farthest, num *value)
{
    const double *unit = (const double *)(form + 2 * n * n);
    num place = {re, im}, *mean = value + k, *power = mean + 1, *mean_slope = power + k - 1;
    num *power_slope = mean_slope + d;
    long ended = 0, *order = malloc(n * sizeof(long));
    num *T = malloc((2 * n * n + 3 * n * k + 3 * k * k + n) * sizeof(num));
    double *flat = malloc((2 * n * n + n) * sizeof(double));
    if (!order || !T || !flat) {
        ended = -1;
        goto done;
    }
    num *Z = T + n * n, *X = Z + n * n, *left = X + n * k, *turned = left + n * k, *N = turned + n * k;
    num *R = N + k * k, *before = R + k * k, *diagonal = before + k * k;
    memcpy(T, form, 2 * n * n * sizeof(num));
    for (long i = 0; i < n; i++) diagonal[i] = T[i * n + i];
    nearest(n, diagonal, place, flat, order);
    if (k < n && !(flat[k] > flat[k - 1] * (1 + 1e-9))) goto done;
    /* the chosen ones move to the top in the order in which they are */
    for (long at = 0, top = 0; at < n; at++) {
        int chosen = 0;
        for (long i = 0; i < k; i++) chosen |= order[i] == at;
        if (!chosen) continue;
        for (long i = at - 1; i >= top; i--) exchange(n, T, Z, i);
        top++;
    }
    if (k < n && !(coupling(n, k, T, X) < farthest)) goto done;
    num sum = {0.0, 0.0};
    for (long i = 0; i < k; i++) value[i] = T[i * n + i], sum.re += value[i].re / k, sum.im += value[i].im / k;
    *mean = sum;
    for (long i = 0; i < k; i++) {
        for (long j = 0; j < n; j++) {
            num y = {Z[i * n + j].re, -Z[i * n + j].im};
            for (long l = k; l < n; l++) {
                num x = X[i * (n - k) + l - k], z = Z[l * n + j];
                y.re += x.re * z.re + x.im * z.im, y.im += x.im * z.re - x.re * z.im;
            }
            left[i * n + j] = (num){y.re / unit[j], y.im / unit[j]};
            turned[i * n + j] = (num){Z[i * n + j].re * unit[j], Z[i * n + j].im * unit[j]};
        }
        for (long j = 0; j < k; j++) {
            num t = j < i ? (num){0.0, 0.0} : T[i * n + j];
            if (i == j) t.re -= sum.re, t.im -= sum.im;
            N[i * k + j] = (num){t.re / rate, t.im / rate};
            R[i * k + j] = (num){i == j, 0.0};
        }
    }
    /* trace of N^(j-1) left dA right, with R = N^(j-1) */
    for (long j = 1; j <= k; j++) {
        num trace = {0.0, 0.0};
        for (long i = 0; i < k; i++) trace.re += R[i * k + i].re, trace.im += R[i * k + i].im;
        memset(flat, 0, 2 * n * n * sizeof(double));
        for (long i = 0; i < k; i++)
            for (long a = 0; a < n; a++) {
                num w = {0.0, 0.0};
                for (long l = i; l < k; l++) {
                    num t = times(R[i * k + l], left[l * n + a]);
                    w.re += t.re, w.im += t.im;
                }
                const num *v = turned + i * n;
                double *restrict re = flat + a * n, *restrict im = re + n * n;
                for (long b = 0; b < n; b++)
                    re[b] += w.re * v[b].re - w.im * v[b].im, im[b] += w.re * v[b].im + w.im * v[b].re;
            }
        num *out = j == 1 ? mean_slope : power_slope + (j - 2) * d;
        double share = j == 1 ? 1.0 / k : j / (k * rate);
        for (long p = 0; p < d; p++) {
            const double *M = dA + p * n * n;
            double re = 0.0, im = 0.0;
            for (long i = 0; i < n * n; i++) re += flat[i] * M[i], im += flat[n * n + i] * M[i];
            if (j > 1) {
                num t = times(trace, mean_slope[p]);
                re -= t.re, im -= t.im;
            }
            out[p] = (num){share * re, share * im};
        }
        memcpy(before, R, k * k * sizeof(num));
        product(k, before, N, R);
        if (j > 1) {
            /* R is now N^j */
            num t = {0.0, 0.0};
            for (long i = 0; i < k; i++) t.re += R[i * k + i].re / k, t.im += R[i * k + i].im / k;
            power[j - 2] = t;
        }
    }
    ended = 1;
done:
    free(order), free(T), free(flat);
    return ended;
}
"""

EIGENSYSTEMS = r"""
static double length_of(long n, const num *v, long stride)
{
    double sum = 0.0;
    for (long i = 0; i < n; i++) sum += square(v[i * stride]);
    return sqrt(sum);
}

/* Eigenvalues (n) of m matrices, right eigenvectors of length one as columns, left ones as rows with products of one;
   those of a defective matrix are no longer than `longest`. Returns 0 when the eigenvalues of one are not found. */
long eigensystems(long m, long n, const double *A, double longest, num *value, num *right, num *left)
{
    long ended = 1;
    num *T = malloc((2 * n * n + (n + 1) / 2 + 3 * n) * sizeof(num));
    if (!T) return -1;
    num *Z = T + n * n, *own = Z + n * n + (n + 1) / 2, *x = own + n, *y = x + n;
    const double *unit = (const double *)(Z + n * n);
    for (long l = 0; l < m && ended == 1; l++, A += n * n, value += n, right += n * n, left += n * n) {
        ended = schur_form(n, A, T);
        if (ended != 1) break;
        memcpy(value, own, n * sizeof(num));
        double size = 0.0;
        for (long i = 0; i < n * n; i++) size = fmax(size, fmax(fabs(T[i].re), fabs(T[i].im)));
        for (long k = 0; k < n; k++) {
            for (int side = 0; side < 2; side++) {
                num *v = side ? y : x;
                long step = side ? 1 : -1;
                v[k] = (num){1.0, 0.0};
                for (long i = k + step; i >= 0 && i < n; i += step) {
                    num sum = {0.0, 0.0}, off = {T[k * n + k].re - T[i * n + i].re, T[k * n + k].im - T[i * n + i].im};
                    for (long j = k; j != i; j += step) {
                        num t = times(v[j], side ? T[j * n + i] : T[i * n + j]);
                        sum.re += t.re, sum.im += t.im;
                    }
                    if (!(square(off) > 4.9e-32 * size * size)) off = (num){2.2e-16 * size + 1e-300, 0.0};
                    v[i] = over(sum, off);
                    if (!(square(v[i]) < 1e200))
                        for (long j = k; j != i + step; j += step) v[j].re *= 1e-100, v[j].im *= 1e-100;
                }
            }
            for (long b = 0; b < n; b++) {
                num v = {0.0, 0.0}, w = {0.0, 0.0};
                for (long i = 0; i <= k; i++) {
                    num t = times(x[i], Z[i * n + b]);
                    v.re += t.re, v.im += t.im;
                }
                for (long i = k; i < n; i++) {
                    num t = times(y[i], (num){Z[i * n + b].re, -Z[i * n + b].im});
                    w.re += t.re, w.im += t.im;
                }
                right[b * n + k] = (num){v.re * unit[b], v.im * unit[b]};
                left[k * n + b] = (num){w.re / unit[b], w.im / unit[b]};
            }
            double one = length_of(n, right + k, n), other = length_of(n, left + k * n, 1);
            num product = times(x[k], y[k]);
            double scale = one / hypot(product.re, product.im);
            if (!(other * scale < longest)) scale = longest / other;
            for (long b = 0; b < n; b++) {
                right[b * n + k].re /= one, right[b * n + k].im /= one;
                left[k * n + b].re *= scale, left[k * n + b].im *= scale;
            }
        }
    }
    free(T);
    return ended;
}
"""
