"""C source of the kernels of gradients, of peaks and of eigenvalues; it follows that of the peaks."""

from __future__ import annotations

SLOPES = r"""
/* LU factors with row exchanges of a complex matrix, in place; a zero pivot becomes `tiny`. */
static void factor(long n, num *M, long *order, double tiny)
{
    for (long k = 0; k < n; k++) {
        long best = k;
        for (long i = k + 1; i < n; i++)
            if (square(M[i * n + k]) > square(M[best * n + k])) best = i;
        order[k] = best;
        if (best != k)
            for (long j = 0; j < n; j++) {
                num t = M[k * n + j];
                M[k * n + j] = M[best * n + j], M[best * n + j] = t;
            }
        if (square(M[k * n + k]) < tiny * tiny) M[k * n + k] = (num){tiny, 0.0};
        for (long i = k + 1; i < n; i++) {
            num f = M[i * n + k];
            if (f.re == 0 && f.im == 0) continue;
            f = M[i * n + k] = over(f, M[k * n + k]);
            for (long j = k + 1; j < n; j++) {
                num t = M[k * n + j];
                M[i * n + j].re -= f.re * t.re - f.im * t.im, M[i * n + j].im -= f.re * t.im + f.im * t.re;
            }
        }
    }
}

/* Solution of M x = b in place. */
static void solve(long n, const num *M, const long *order, num *x)
{
    for (long k = 0; k < n; k++) {
        num t = x[k];
        x[k] = x[order[k]], x[order[k]] = t;
    }
    for (long i = 1; i < n; i++)
        for (long j = 0; j < i; j++) {
            num t = times(M[i * n + j], x[j]);
            x[i].re -= t.re, x[i].im -= t.im;
        }
    for (long i = n - 1; i >= 0; i--) {
        for (long j = i + 1; j < n; j++) {
            num t = times(M[i * n + j], x[j]);
            x[i].re -= t.re, x[i].im -= t.im;
        }
        x[i] = over(x[i], M[i * n + i]);
    }
}

/* Solution of y M = b for a row, in place. */
static void solve_row(long n, const num *M, const long *order, num *y)
{
    for (long i = 0; i < n; i++) {
        for (long j = 0; j < i; j++) {
            num t = times(M[j * n + i], y[j]);
            y[i].re -= t.re, y[i].im -= t.im;
        }
        y[i] = over(y[i], M[i * n + i]);
    }
    for (long i = n - 2; i >= 0; i--)
        for (long j = i + 1; j < n; j++) {
            num t = times(M[j * n + i], y[j]);
            y[i].re -= t.re, y[i].im -= t.im;
        }
    for (long k = n - 1; k >= 0; k--) {
        num t = y[k];
        y[k] = y[order[k]], y[order[k]] = t;
    }
}

/* Real part of w M v for d real matrices (rows, columns): with T = Re(w v), a sum of products. */
static void contract(long d, long rows, long columns, const double *M, long stride, const num *w, const num *v,
                     double *T, double *out)
{
    for (long i = 0; i < rows; i++)
        for (long j = 0; j < columns; j++) T[i * columns + j] = w[i].re * v[j].re - w[i].im * v[j].im;
    for (long p = 0; p < d; p++, M += stride) {
        double sum = 0.0;
        for (long i = 0; i < rows * columns; i++) sum += M[i] * T[i];
        out[p] += sum;
    }
}

/* Largest singular values of k two by two responses at given frequencies, and their gradients (k, d). */
long peak_slopes(long k, long n, long d, long n_y, long row, const long *loop, const double *w, const double *A,
                 const double *B, const double *C, const double *D, const double *dA, const double *dB,
                 const double *dC, const double *dD, double *value, double *slope)
{
    num *M = malloc((n * n + 4 * n) * sizeof(num));
    double *T = malloc((n * n + 2 * n) * sizeof(double));
    long *order = malloc(n * sizeof(long));
    if (!M || !T || !order) {
        free(M), free(T), free(order);
        return -1;
    }
    num *X[2] = {M + n * n, M + n * n + n}, *u_row = M + n * n + 2 * n, *x_v = u_row + n;
    for (long q = 0; q < k; q++) {
        long l = loop[q];
        const double *a = A + l * n * n, *b = B + l * n * 2;
        const double *c = C + (l * n_y + row) * n, *D_l = D + (l * n_y + row) * 2;
        double *g = slope + q * d;
        for (long i = 0; i < n * n; i++) M[i] = (num){-a[i], 0.0};
        for (long i = 0; i < n; i++) M[i * n + i].im = w[q];
        factor(n, M, order, 1e-300);
        num S[2][2];
        for (int j = 0; j < 2; j++) {
            for (long i = 0; i < n; i++) X[j][i] = (num){b[2 * i + j], 0.0};
            solve(n, M, order, X[j]);
            for (int r = 0; r < 2; r++) {
                num sum = {D_l[2 * r + j], 0.0};
                for (long i = 0; i < n; i++) sum.re += c[r * n + i] * X[j][i].re, sum.im += c[r * n + i] * X[j][i].im;
                S[r][j] = sum;
            }
        }
        /* eigenvector of S* S of its larger eigenvalue */
        double h0 = square(S[0][0]) + square(S[1][0]), h1 = square(S[0][1]) + square(S[1][1]);
        num h = {0.0, 0.0};
        for (int r = 0; r < 2; r++) {
            h.re += S[r][0].re * S[r][1].re + S[r][0].im * S[r][1].im;
            h.im += S[r][0].re * S[r][1].im - S[r][0].im * S[r][1].re;
        }
        double half = (h0 - h1) / 2, radius = sqrt(half * half + square(h));
        num v[2], u[2];
        if (half >= 0) v[0] = (num){half + radius, 0.0}, v[1] = (num){h.re, -h.im};
        else v[0] = h, v[1] = (num){radius - half, 0.0};
        double length = sqrt(square(v[0]) + square(v[1]));
        if (!(length > 0)) v[0] = (num){1.0, 0.0}, v[1] = (num){0.0, 0.0}, length = 1.0;
        for (int j = 0; j < 2; j++) v[j].re /= length, v[j].im /= length;
        for (int r = 0; r < 2; r++) {
            num x = times(S[r][0], v[0]), y = times(S[r][1], v[1]);
            u[r] = (num){x.re + y.re, x.im + y.im};
        }
        value[q] = sqrt(square(u[0]) + square(u[1]));
        double unit = value[q] > 0 ? value[q] : 1.0;
        for (int r = 0; r < 2; r++) u[r] = (num){u[r].re / unit, -u[r].im / unit};
        for (long i = 0; i < n; i++) {
            num x = times(X[0][i], v[0]), y = times(X[1][i], v[1]);
            x_v[i] = (num){x.re + y.re, x.im + y.im};
            u_row[i] = (num){u[0].re * c[i] + u[1].re * c[n + i], u[0].im * c[i] + u[1].im * c[n + i]};
        }
        solve_row(n, M, order, u_row);
        memset(g, 0, d * sizeof(double));
        contract(d, 2, 2, dD + l * d * n_y * 2 + row * 2, n_y * 2, u, v, T, g);
        contract(d, 2, n, dC + l * d * n_y * n + row * n, n_y * n, u, x_v, T, g);
        contract(d, n, 2, dB + l * d * n * 2, n * 2, u_row, v, T, g);
        contract(d, n, n, dA + l * d * n * n, n * n, u_row, x_v, T, g);
    }
    free(M), free(T), free(order);
    return 0;
}

/* Eigenvalues near known ones in k nearby matrices, and their gradients (k, d), by inverse iteration on both sides. */
long eigenvalue_slopes(long k, long n, long d, const long *loop, const double *A, const double *dA, num *value,
                       const num *right, const num *left, num *slope)
{
    num *M = malloc((n * n + 2 * n) * sizeof(num));
    double *T = malloc(n * n * sizeof(double));
    long *order = malloc(n * sizeof(long));
    if (!M || !T || !order) {
        free(M), free(T), free(order);
        return -1;
    }
    num *v = M + n * n, *w = v + n;
    for (long q = 0; q < k; q++) {
        const double *a = A + loop[q] * n * n, *da = dA + loop[q] * d * n * n;
        num now = value[q];
        double size = 0.0;
        for (long i = 0; i < n * n; i++) size = fabs(a[i]) > size ? fabs(a[i]) : size;
        memcpy(v, right + q * n, n * sizeof(num)), memcpy(w, left + q * n, n * sizeof(num));
        for (int round = 0; round < 3; round++) {
            for (long i = 0; i < n * n; i++) M[i] = (num){a[i], 0.0};
            for (long i = 0; i < n; i++) M[i * n + i].re -= now.re, M[i * n + i].im -= now.im;
            factor(n, M, order, 1e-16 * size + 1e-300);
            solve(n, M, order, v), solve_row(n, M, order, w);
            double length = 0.0;
            for (long i = 0; i < n; i++) length += square(v[i]);
            length = sqrt(length);
            for (long i = 0; i < n; i++) v[i].re /= length, v[i].im /= length;
            num product = {0.0, 0.0}, moved = {0.0, 0.0};
            for (long i = 0; i < n; i++) {
                num t = times(w[i], v[i]);
                product.re += t.re, product.im += t.im;
            }
            for (long i = 0; i < n; i++) w[i] = over(w[i], product);
            for (long i = 0; i < n; i++) {
                num sum = {0.0, 0.0};
                for (long j = 0; j < n; j++) sum.re += a[i * n + j] * v[j].re, sum.im += a[i * n + j] * v[j].im;
                sum = times(w[i], sum);
                moved.re += sum.re, moved.im += sum.im;
            }
            num step = {moved.re - now.re, moved.im - now.im};
            now = moved;
            if (!(square(step) > 1e-14 * square(now))) break;
        }
        value[q] = now;
        for (int part = 0; part < 2; part++) {
            for (long i = 0; i < n; i++)
                for (long j = 0; j < n; j++)
                    T[i * n + j] = part ? w[i].re * v[j].im + w[i].im * v[j].re : w[i].re * v[j].re - w[i].im * v[j].im;
            for (long p = 0; p < d; p++) {
                double sum = 0.0;
                for (long i = 0; i < n * n; i++) sum += da[p * n * n + i] * T[i];
                if (part) slope[q * d + p].im = sum;
                else slope[q * d + p].re = sum;
            }
        }
    }
    free(M), free(T), free(order);
    return 0;
}
"""
