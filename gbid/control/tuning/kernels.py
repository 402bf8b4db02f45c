"""Compiled kernels in C: eigenvalues, eigenvectors and clusters of small matrices; peaks and slopes of responses.

For matrices of ten states they take a half to a fifth of the time of calls of LAPACK.
"""

from __future__ import annotations

import ctypes
from functools import cache

import numpy as np

from gbid.control.tuning.loops import Derivatives
from gbid.core.arrays import ComplexArray, FloatArray, IntArray
from gbid.core.compiled import CompilerMissingError, Library, load_library

SchurResponse = tuple[ComplexArray, ComplexArray, ComplexArray]
"""Schur form (n, n) of a loop, with its inputs and outputs in that basis."""

_SOURCE = r"""
#include <math.h>
#include <stdlib.h>
#include <string.h>

typedef struct { double re, im; } num;

static num times(num a, num b) { return (num){a.re * b.re - a.im * b.im, a.re * b.im + a.im * b.re}; }
static num over(num a, num b)
{
    double size = b.re * b.re + b.im * b.im;
    return (num){(a.re * b.re + a.im * b.im) / size, (a.im * b.re - a.re * b.im) / size};
}
static double square(num a) { return a.re * a.re + a.im * a.im; }

/* Whether all of some numbers are finite, and powers of eigenvalues of matrices of them are, too. */
static int all_finite(long count, const double *A)
{
    for (long i = 0; i < count; i++)
        if (!(fabs(A[i]) < 1e60)) return 0;
    return 1;
}

/* Units of the states, powers of two, in which rows and columns of A have similar lengths; A is changed to them. */
static void balance(long n, double *A, double *unit)
{
    for (long i = 0; i < n; i++) unit[i] = 1.0;
    for (int round = 0, changed = 1; changed && round < 60; round++) {
        changed = 0;
        for (long i = 0; i < n; i++) {
            double column = 0.0, row = 0.0, f = 1.0;
            for (long j = 0; j < n; j++)
                if (j != i) column += fabs(A[j * n + i]), row += fabs(A[i * n + j]);
            if (!(column > 0) || !(row > 0)) continue;
            double before = column + row;
            while (column < row / 2 && f < 1e30) f *= 2, column *= 4;
            while (column >= row * 2 && f > 1e-30) f /= 2, column /= 4;
            if (!((column + row) / f < 0.95 * before)) continue;
            changed = 1, unit[i] *= f;
            for (long j = 0; j < n; j++) A[i * n + j] /= f;
            for (long j = 0; j < n; j++) A[j * n + i] *= f;
        }
    }
}

/* Reflection of the rows of M from `first` on: M - weight v (v' M). */
static void from_rows(long n, long first, double *M, double *v, double weight)
{
    double *restrict product = v + n;
    for (long j = 0; j < n; j++) product[j] = 0.0;
    for (long i = first; i < n; i++)
        for (long j = 0; j < n; j++) product[j] += v[i] * M[i * n + j];
    for (long i = first; i < n; i++)
        for (long j = 0; j < n; j++) M[i * n + j] -= weight * v[i] * product[j];
}

/* Hessenberg form of A in place, by reflections; the vectors of its basis become the rows of Q unless it is null. */
static void to_hessenberg(long n, double *A, double *Q, double *v)
{
    if (Q)
        for (long i = 0; i < n * n; i++) Q[i] = i % (n + 1) == 0;
    for (long k = 0; k + 2 < n; k++) {
        double size = 0.0, sum = 0.0;
        for (long i = k + 1; i < n; i++) size = fabs(A[i * n + k]) > size ? fabs(A[i * n + k]) : size;
        if (!(size > 0)) continue;
        for (long i = k + 1; i < n; i++) v[i] = A[i * n + k] / size, sum += v[i] * v[i];
        double length = v[k + 1] > 0 ? -sqrt(sum) : sqrt(sum), weight = 1.0 / (sum - v[k + 1] * length);
        v[k + 1] -= length;
        from_rows(n, k + 1, A, v, weight);
        for (long i = 0; i < n; i++) {
            double product = 0.0;
            for (long j = k + 1; j < n; j++) product += A[i * n + j] * v[j];
            for (long j = k + 1; j < n; j++) A[i * n + j] -= weight * product * v[j];
        }
        if (Q) from_rows(n, k + 1, Q, v, weight);
        A[(k + 1) * n + k] = size * length;
        for (long i = k + 2; i < n; i++) A[i * n + k] = 0.0;
    }
}

/* Reflection of two or three rows: their sum with weights a, b, c, times d, e, f, is taken from each. */
static void reflect(double *restrict row, long n, int three, long first, long last, double a, double b, double c,
                    double d, double e, double f)
{
    double *restrict next = row + n, *restrict third = row + 2 * n;
    if (three)
        for (long j = first; j <= last; j++) {
            double t = a * row[j] + b * next[j] + c * third[j];
            row[j] -= t * d, next[j] -= t * e, third[j] -= t * f;
        }
    else
        for (long j = first; j <= last; j++) {
            double t = a * row[j] + b * next[j];
            row[j] -= t * d, next[j] -= t * e;
        }
}

static double with_sign(double size, double of) { return of < 0 ? -fabs(size) : fabs(size); }

/* Eigenvalues of a Hessenberg matrix, which is destroyed, by Francis' double shifts (EISPACK: hqr2); 0 if they fail.
   With the vectors of its basis as rows of Z, H becomes its real Schur form with blocks of two, and Z that one's. */
static int francis(long n, double *H, double *Z, num *value)
{
    const double eps = 2.2e-16;
    double norm = 0.0, shift = 0.0, p = 0, q = 0, r = 0, s, w, x, y, z;
    for (long i = 0; i < n; i++)
        for (long j = i > 0 ? i - 1 : 0; j < n; j++) norm += fabs(H[i * n + j]);
    if (!(norm - norm == 0)) return 0;
    for (long end = n - 1, its = 0; end >= 0;) {
        long low = end, m;
        for (; low > 0; low--) {
            s = fabs(H[(low - 1) * n + low - 1]) + fabs(H[low * n + low]);
            if (fabs(H[low * n + low - 1]) <= eps * (s > 0 ? s : norm)) break;
        }
        x = H[end * n + end];
        if (low > 0) H[low * n + low - 1] = 0.0;
        if (low == end) {
            H[end * n + end] = x + shift;
            value[end--] = (num){x + shift, 0.0}, its = 0;
            continue;
        }
        y = H[(end - 1) * n + end - 1], w = H[end * n + end - 1] * H[(end - 1) * n + end];
        if (low == end - 1) {
            H[end * n + end] = x + shift, H[(end - 1) * n + end - 1] = y + shift;
            p = 0.5 * (y - x), q = p * p + w, z = sqrt(fabs(q)), x += shift;
            if (q >= 0) {
                z = p + with_sign(z, p);
                value[end - 1] = (num){x + z, 0.0}, value[end] = (num){z != 0 ? x - w / z : x + z, 0.0};
            } else {
                value[end - 1] = (num){x + p, z}, value[end] = (num){x + p, -z};
            }
            end -= 2, its = 0;
            continue;
        }
        if (its == 90) return 0;
        if (its % 10 == 0 && its > 0) {
            shift += x;
            for (long i = 0; i <= end; i++) H[i * n + i] -= x;
            s = fabs(H[end * n + end - 1]) + fabs(H[(end - 1) * n + end - 2]);
            x = y = 0.75 * s, w = -0.4375 * s * s;
        }
        its++;
        for (m = end - 2; m >= low; m--) {
            z = H[m * n + m], r = x - z, s = y - z;
            p = (r * s - w) / H[(m + 1) * n + m] + H[m * n + m + 1];
            q = H[(m + 1) * n + m + 1] - z - r - s, r = H[(m + 2) * n + m + 1];
            s = fabs(p) + fabs(q) + fabs(r), p /= s, q /= s, r /= s;
            if (m == low) break;
            double u = fabs(H[m * n + m - 1]) * (fabs(q) + fabs(r));
            double t = fabs(H[(m - 1) * n + m - 1]) + fabs(z) + fabs(H[(m + 1) * n + m + 1]);
            if (u <= eps * fabs(p) * t) break;
        }
        for (long i = m + 2; i <= end; i++) {
            H[i * n + i - 2] = 0.0;
            if (i > m + 2) H[i * n + i - 3] = 0.0;
        }
        for (long k = m; k < end; k++) {
            int three = k + 1 < end;
            if (k > m) {
                p = H[k * n + k - 1], q = H[(k + 1) * n + k - 1], r = three ? H[(k + 2) * n + k - 1] : 0.0;
                x = fabs(p) + fabs(q) + fabs(r);
                if (!(x > 0)) continue;
                p /= x, q /= x, r /= x;
            }
            s = with_sign(sqrt(p * p + q * q + r * r), p);
            if (s == 0) continue;
            if (k > m) H[k * n + k - 1] = -s * x;
            else if (low < m) H[k * n + k - 1] = -H[k * n + k - 1];
            p += s, x = p / s, y = q / s, z = r / s, q /= p, r /= p;
            reflect(H + k * n, n, three, k, Z ? n - 1 : end, 1.0, q, r, x, y, z);
            long bottom = end < k + 3 ? end : k + 3;
            for (long i = Z ? 0 : low; i <= bottom; i++) {
                double *h = H + i * n + k, t = x * h[0] + y * h[1] + (three ? z * h[2] : 0.0);
                h[0] -= t, h[1] -= t * q;
                if (three) h[2] -= t * r;
            }
            if (Z) reflect(Z + k * n, n, three, 0, n - 1, x, y, z, 1.0, q, r);
        }
    }
    return 1;
}

/* Order of numbers by their distance from a place, which is written beside. */
static void nearest(long n, const num *value, num place, double *distance, long *order)
{
    for (long i = 0; i < n; i++) {
        long at = i;
        double far = hypot(value[i].re - place.re, value[i].im - place.im);
        for (; at > 0 && distance[at - 1] > far; at--) distance[at] = distance[at - 1], order[at] = order[at - 1];
        distance[at] = far, order[at] = i;
    }
}

/* Eigenvalues (n) of m matrices. Returns 0 when those of one are not found. */
long spectra(long m, long n, const double *A, num *value)
{
    long ended = all_finite(m * n * n, A);
    double *work = malloc((n * n + 4 * n) * sizeof(double));
    if (!work) return -1;
    for (long l = 0; l < m && ended; l++) {
        memcpy(work, A + l * n * n, n * n * sizeof(double));
        balance(n, work, work + n * n);
        to_hessenberg(n, work, 0, work + n * n);
        ended = francis(n, work, 0, value + l * n);
    }
    free(work);
    return ended;
}

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

/* Products of k vectors (n) with a real matrix, entry (j, a) of which is at M[j * along + a * across]: (k, p). */
static void project(long k, long n, long p, const num *x, const double *M, long along, long across, num *out)
{
    for (long i = 0; i < k; i++, x += n, out += p)
        for (long a = 0; a < p; a++) {
            num sum = {0.0, 0.0};
            for (long j = 0; j < n; j++) {
                double entry = M[j * along + a * across];
                sum.re += entry * x[j].re, sum.im += entry * x[j].im;
            }
            out[a] = sum;
        }
}

/* Mean and power sums of the k eigenvalues of a Schur form nearest to a place, see `Cluster`: the k
   eigenvalues, mean, k - 1 sums, and the gradients (d) of each, from the derivatives L core R (n, p, q, n) of the
   matrix. Returns 0 when they are not apart from the others. */
long cluster(long n, long d, long k, long p, long q, const num *form, const double *L, const double *core,
             const double *R, double re, double im, double rate, double farthest, num *value)
{
    const double *unit = (const double *)(form + 2 * n * n);
    num place = {re, im}, *mean = value + k, *power = mean + 1, *mean_slope = power + k - 1;
    num *power_slope = mean_slope + d;
    long ended = 0, *order = malloc(n * sizeof(long));
    num *T = malloc((2 * n * n + (3 * n + p + q) * k + 3 * k * k + n) * sizeof(num));
    double *flat = malloc((2 * p * q + n) * sizeof(double));
    if (!order || !T || !flat) {
        ended = -1;
        goto done;
    }
    num *Z = T + n * n, *X = Z + n * n, *left = X + n * k, *turned = left + n * k, *N = turned + n * k;
    num *power_of_N = N + k * k, *before = power_of_N + k * k, *diagonal = before + k * k;
    num *rows = diagonal + n, *columns = rows + k * p;
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
            power_of_N[i * k + j] = (num){i == j, 0.0};
        }
    }
    project(k, n, p, left, L, p, 1, rows), project(k, n, q, turned, R, 1, n, columns);
    /* trace of N^(j-1) rows core columns */
    for (long j = 1; j <= k; j++) {
        num trace = {0.0, 0.0};
        for (long i = 0; i < k; i++) trace.re += power_of_N[i * k + i].re, trace.im += power_of_N[i * k + i].im;
        memset(flat, 0, 2 * p * q * sizeof(double));
        for (long i = 0; i < k; i++)
            for (long a = 0; a < p; a++) {
                num w = {0.0, 0.0};
                for (long l = i; l < k; l++) {
                    num t = times(power_of_N[i * k + l], rows[l * p + a]);
                    w.re += t.re, w.im += t.im;
                }
                const num *v = columns + i * q;
                double *restrict re = flat + a * q, *restrict im = re + p * q;
                for (long b = 0; b < q; b++)
                    re[b] += w.re * v[b].re - w.im * v[b].im, im[b] += w.re * v[b].im + w.im * v[b].re;
            }
        num *out = j == 1 ? mean_slope : power_slope + (j - 2) * d;
        double share = j == 1 ? 1.0 / k : j / (k * rate);
        for (long g = 0; g < d; g++) {
            const double *M = core + g * p * q;
            double re = 0.0, im = 0.0;
            for (long i = 0; i < p * q; i++) re += flat[i] * M[i], im += flat[p * q + i] * M[i];
            if (j > 1) {
                num t = times(trace, mean_slope[g]);
                re -= t.re, im -= t.im;
            }
            out[g] = (num){share * re, share * im};
        }
        memcpy(before, power_of_N, k * k * sizeof(num));
        product(k, before, N, power_of_N);
        if (j > 1) {
            num t = {0.0, 0.0};
            for (long i = 0; i < k; i++) t.re += power_of_N[i * k + i].re / k, t.im += power_of_N[i * k + i].im / k;
            power[j - 2] = t;
        }
    }
    ended = 1;
done:
    free(order), free(T), free(flat);
    return ended;
}

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
    long ended = all_finite(m * n * n, A);
    num *T = malloc((3 * n * n + (n + 1) / 2 + 2 * n) * sizeof(num));
    if (!T) return -1;
    num *Z = T + n * n, *own = Z + n * n + (n + 1) / 2, *y = own + n, *X = y + n;
    const double *unit = (const double *)(Z + n * n);
    for (long l = 0; l < m && ended == 1; l++, A += n * n, value += n, right += n * n, left += n * n) {
        ended = schur_form(n, A, T);
        if (ended != 1) break;
        memcpy(value, own, n * sizeof(num));
        double size = 0.0;
        for (long i = 0; i < n * n; i++) size = fmax(size, fmax(fabs(T[i].re), fabs(T[i].im)));
        for (long k = 0; k < n; k++) { /* right eigenvectors of T, in the columns of X */
            num *x = X + k * n;
            x[k] = (num){1.0, 0.0};
            for (long i = k - 1; i >= 0; i--) {
                num sum = {0.0, 0.0}, off = {T[k * n + k].re - T[i * n + i].re, T[k * n + k].im - T[i * n + i].im};
                for (long j = k; j > i; j--) {
                    num t = times(x[j], T[i * n + j]);
                    sum.re += t.re, sum.im += t.im;
                }
                if (!(square(off) > 4.9e-32 * size * size)) off = (num){2.2e-16 * size + 1e-300, 0.0};
                x[i] = over(sum, off);
                if (!(square(x[i]) < 1e200))
                    for (long j = k; j >= i; j--) x[j].re *= 1e-100, x[j].im *= 1e-100;
            }
        }
        for (long k = 0; k < n; k++) { /* left ones are the rows of its inverse: those of equal eigenvalues fit, too */
            const num *x = X + k * n;
            y[k] = (num){1.0, 0.0};
            for (long i = k + 1; i < n; i++) {
                num sum = {0.0, 0.0};
                for (long j = k; j < i; j++) {
                    num t = times(y[j], X[i * n + j]);
                    sum.re -= t.re, sum.im -= t.im;
                }
                y[i] = over(sum, X[i * n + i]);
                if (!(square(y[i]) < 1e200))
                    for (long j = k; j <= i; j++) y[j].re *= 1e-100, y[j].im *= 1e-100;
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

/* Largest singular values of k two by two responses at given frequencies, and their gradients (k, d), from the
   derivatives L core R of [[A, B], [C, D]], (n + n_y, p, q, n + 2). */
long peak_slopes(long k, long n, long d, long n_y, long row, long p, long q, const long *loop, const double *w,
                 const double *A, const double *B, const double *C, const double *D, const double *L,
                 const double *core, const double *R, double *value, double *slope)
{
    num *M = calloc(n * n + 4 * n + n_y + 2 + p + q, sizeof(num));
    long *order = malloc(n * sizeof(long));
    if (!M || !order) {
        free(M), free(order);
        return -1;
    }
    num *X[2] = {M + n * n, M + n * n + n}, *u_row = M + n * n + 2 * n, *u = u_row + n + row, *x_v = u_row + n + n_y;
    num *v = x_v + n, *left = v + 2, *right = left + p;
    for (long i_peak = 0; i_peak < k; i_peak++) {
        long l = loop[i_peak];
        const double *a = A + l * n * n, *b = B + l * n * 2;
        const double *c = C + (l * n_y + row) * n, *D_l = D + (l * n_y + row) * 2;
        double *g = slope + i_peak * d;
        for (long i = 0; i < n * n; i++) M[i] = (num){-a[i], 0.0};
        for (long i = 0; i < n; i++) M[i * n + i].im = w[i_peak];
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
        if (half >= 0) v[0] = (num){half + radius, 0.0}, v[1] = (num){h.re, -h.im};
        else v[0] = h, v[1] = (num){radius - half, 0.0};
        double length = sqrt(square(v[0]) + square(v[1]));
        if (!(length > 0)) v[0] = (num){1.0, 0.0}, v[1] = (num){0.0, 0.0}, length = 1.0;
        for (int j = 0; j < 2; j++) v[j].re /= length, v[j].im /= length;
        for (int r = 0; r < 2; r++) {
            num x = times(S[r][0], v[0]), y = times(S[r][1], v[1]);
            u[r] = (num){x.re + y.re, x.im + y.im};
        }
        double height = value[i_peak] = sqrt(square(u[0]) + square(u[1])), unit = height > 0 ? height : 1.0;
        for (int r = 0; r < 2; r++) u[r] = (num){u[r].re / unit, -u[r].im / unit};
        for (long i = 0; i < n; i++) {
            num x = times(X[0][i], v[0]), y = times(X[1][i], v[1]);
            x_v[i] = (num){x.re + y.re, x.im + y.im};
            u_row[i] = (num){u[0].re * c[i] + u[1].re * c[n + i], u[0].im * c[i] + u[1].im * c[n + i]};
        }
        solve_row(n, M, order, u_row);
        project(1, n + n_y, p, u_row, L + l * (n + n_y) * p, p, 1, left);
        project(1, n + 2, q, x_v, R + l * q * (n + 2), 1, n + 2, right);
        for (long i = 0; i < d; i++) {
            const double *M_i = core + (l * d + i) * p * q;
            double sum = 0.0;
            for (long a = 0; a < p; a++)
                for (long b = 0; b < q; b++)
                    sum += M_i[a * q + b] * (left[a].re * right[b].re - left[a].im * right[b].im);
            g[i] = sum;
        }
    }
    free(M), free(order);
    return 0;
}

/* Peaks of two by two responses over frequency: on a grid of 200 frequencies, a tenth of numpy's time. */

/* One loop: modes (poles and residues), or for nearly parallel eigenvectors its Schur form with inputs and outputs. */
typedef struct { long n; const num *pole, *residue, *form, *inputs, *outputs; const double *D; } loop_response;

enum { TILE = 32 };

/* Entries of the response at frequencies w, as real and imaginary parts: sum over modes. */
static void of_modes(const loop_response *l, long count, const double *restrict w, double e[8][TILE])
{
    for (long k = 0; k < l->n; k++) {
        const num *r = l->residue + 4 * k;
        double rate = l->pole[k].re, place = l->pole[k].im;
        for (long i = 0; i < count; i++) {
            double off = w[i] - place, size = 1.0 / (rate * rate + off * off), x = -rate * size, y = -off * size;
            e[0][i] += x * r[0].re - y * r[0].im, e[1][i] += x * r[0].im + y * r[0].re;
            e[2][i] += x * r[1].re - y * r[1].im, e[3][i] += x * r[1].im + y * r[1].re;
            e[4][i] += x * r[2].re - y * r[2].im, e[5][i] += x * r[2].im + y * r[2].re;
            e[6][i] += x * r[3].re - y * r[3].im, e[7][i] += x * r[3].im + y * r[3].re;
        }
    }
}

/* The same by substitution in (j w - form) X = inputs; `work` holds X, four rows of TILE numbers for each state. */
static void of_form(const loop_response *l, long count, const double *restrict w, double (*work)[4][TILE],
                    double e[8][TILE])
{
    long n = l->n;
    for (long k = n - 1; k >= 0; k--) {
        double(*restrict X)[TILE] = work[k];
        num b0 = l->inputs[2 * k], b1 = l->inputs[2 * k + 1], t = l->form[k * n + k];
        for (long i = 0; i < TILE; i++) X[0][i] = b0.re, X[1][i] = b0.im, X[2][i] = b1.re, X[3][i] = b1.im;
        for (long j = k + 1; j < n; j++) {
            num f = l->form[k * n + j];
            double(*restrict Y)[TILE] = work[j];
            for (long i = 0; i < TILE; i++) {
                X[0][i] += f.re * Y[0][i] - f.im * Y[1][i], X[1][i] += f.re * Y[1][i] + f.im * Y[0][i];
                X[2][i] += f.re * Y[2][i] - f.im * Y[3][i], X[3][i] += f.re * Y[3][i] + f.im * Y[2][i];
            }
        }
        for (long i = 0; i < count; i++) {
            double off = w[i] - t.im, size = 1.0 / (t.re * t.re + off * off), x = -t.re * size, y = -off * size;
            double p = X[0][i], q = X[1][i];
            X[0][i] = p * x - q * y, X[1][i] = p * y + q * x;
            p = X[2][i], q = X[3][i];
            X[2][i] = p * x - q * y, X[3][i] = p * y + q * x;
        }
        for (long i = count; i < TILE; i++) X[0][i] = X[1][i] = X[2][i] = X[3][i] = 0.0;
        for (int r = 0; r < 2; r++) {
            num c = l->outputs[r * n + k];
            for (long i = 0; i < TILE; i++) {
                e[4 * r][i] += c.re * X[0][i] - c.im * X[1][i], e[4 * r + 1][i] += c.re * X[1][i] + c.im * X[0][i];
                e[4 * r + 2][i] += c.re * X[2][i] - c.im * X[3][i], e[4 * r + 3][i] += c.re * X[3][i] + c.im * X[2][i];
            }
        }
    }
}

/* Largest singular values at frequencies w. */
static void gains(const loop_response *l, long total, const double *w, double (*work)[4][TILE], double *out)
{
    double e[8][TILE];
    for (long first = 0; first < total; first += TILE, w += TILE, out += TILE) {
        long count = total - first < TILE ? total - first : TILE;
        for (int k = 0; k < 4; k++)
            for (long i = 0; i < TILE; i++) e[2 * k][i] = l->D[k], e[2 * k + 1][i] = 0.0;
        if (l->form) of_form(l, count, w, work, e);
        else of_modes(l, count, w, e);
        for (long i = 0; i < count; i++) {
            double sum = 0.0, x, y, product, rest;
            for (int k = 0; k < 8; k++) sum += e[k][i] * e[k][i];
            x = e[0][i] * e[6][i] - e[1][i] * e[7][i] - e[2][i] * e[4][i] + e[3][i] * e[5][i];
            y = e[0][i] * e[7][i] + e[1][i] * e[6][i] - e[2][i] * e[5][i] - e[3][i] * e[4][i];
            product = sqrt(x * x + y * y), rest = sum - 2 * product;
            out[i] = 0.5 * (sqrt(sum + 2 * product) + sqrt(rest > 0 ? rest : 0.0));
        }
    }
}

/* Place and height of the parabola through three points; without a top between them, the highest one. */
static void vertex(double middle, double step, const double *v, double *place, double *top)
{
    double bend = 2 * v[1] - v[0] - v[2], rise = (v[2] - v[0]) / 2, share = bend > 0 ? rise / bend : 0.0;
    share = share > 1 ? 1.0 : share < -1 ? -1.0 : share;
    if (fabs(share) < 1) {
        *place = middle + step * share, *top = v[1] + share * rise - share * share * bend / 2;
        return;
    }
    int at = v[1] > v[0] ? (v[2] > v[1] ? 2 : 1) : (v[2] > v[0] ? 2 : 0);
    *place = middle + step * (at - 1.0), *top = v[at];
}

static int ascending(const void *a, const void *b)
{
    double x = *(const double *)a, y = *(const double *)b;
    return (x > y) - (x < y);
}

/* Local maxima over frequency of m loops: returns their number; loop, place and height of each. */
long peaks(long m, long n, long n_base, long n_extra, double least, long most, const num *pole, const num *residue,
           const double *D, const long *form_of, const num *form, const num *inputs, const num *outputs,
           const double *base, const long *extra_loop, const double *extra_w, long *loop, double *place, double *height)
{
    enum { N = 9 };
    long room = n_base + 2 * n + n_extra, found = 0;
    double *grid = malloc(3 * room * sizeof(double)), points[N], there[N];
    double(*work)[4][TILE] = malloc(n * sizeof *work);
    if (!grid || !work) {
        free(grid), free(work);
        return -1;
    }
    double *own = grid + room, *value = own + room;
    for (long l = 0; l < m; l++) {
        const num *p = pole + n * l;
        loop_response r = {n, p, residue + 4 * n * l, 0, 0, 0, D + 4 * l};
        long count = 0, special = form_of[l];
        if (special >= 0) {
            r.form = form + special * n * n;
            r.inputs = inputs + special * 2 * n, r.outputs = outputs + special * 2 * n;
        }
        for (long k = 0; k < n; k++) {
            /* conjugate and real poles give shifted points: two equal frequencies would look like a maximum */
            double size = sqrt(p[k].re * p[k].re + p[k].im * p[k].im);
            int upper = p[k].im > 0;
            own[count++] = upper ? size : 1.07 * size;
            own[count++] = upper ? p[k].im : 0.93 * size;
        }
        for (long k = 0; k < n_extra; k++)
            if (extra_loop[k] == l) own[count++] = extra_w[k];
        qsort(own, count, sizeof(double), ascending);
        long total = 0, i = 0, j = 0;
        while (i < n_base || j < count)
            grid[total++] = j == count || (i < n_base && base[i] <= own[j]) ? base[i++] : own[j++];
        gains(&r, total, grid, work, value);
        double highest = 0.0;
        int sound = 1;
        for (i = 0; i < total; i++) {
            if (!(value[i] - value[i] == 0)) sound = 0;
            if (value[i] > highest) highest = value[i];
        }
        double enough = 0.6 * highest > 0.9 * least ? 0.6 * highest : 0.9 * least;
        for (i = 0; sound && i < total; i++) {
            if (!(value[i] > enough) || (i > 0 && value[i] < value[i - 1])) continue;
            if (i + 1 < total && value[i] <= value[i + 1]) continue;
            double low = grid[i > 0 ? i - 1 : 0], high = grid[i + 1 < total ? i + 1 : i];
            double best = value[i], where = grid[i], three[3], middle, top;
            for (int round = 0; round < 2; round++) {
                for (j = 0; j < N; j++) points[j] = low + (high - low) * (j / (N - 1.0));
                gains(&r, N, points, work, there);
                long at = 0;
                for (j = 1; j < N; j++)
                    if (there[j] > there[at]) at = j;
                at = at < 1 ? 1 : at > N - 2 ? N - 2 : at;
                low = points[at - 1], high = points[at + 1];
                memcpy(three, there + at - 1, sizeof three);
                if (three[1] > best * (1 + 1e-12)) best = three[1], where = points[at];
            }
            double step = (high - low) / 2;
            vertex(low + step, step, three, &middle, &top);
            step *= 0.1;
            for (j = 0; j < 3; j++) points[j] = middle + step * (j - 1.0) > 0 ? middle + step * (j - 1.0) : 0.0;
            gains(&r, 3, points, work, three);
            vertex(middle, step, three, &middle, &top);
            if (found < most) {
                loop[found] = l;
                int better = top > best * (1 + 1e-12);
                place[found] = better ? middle : where;
                height[found++] = better ? top : best;
            }
        }
    }
    free(grid), free(work);
    return found;
}
"""


@cache
def kernels() -> Library | None:
    """Return the compiled library; None without a C compiler: LAPACK then computes the values."""
    try:
        library = load_library(_SOURCE)
    except CompilerMissingError:
        return None
    count, real, place = ctypes.c_long, ctypes.c_double, ctypes.c_void_p
    library.spectra.argtypes = [count, count, place, place]
    library.schur_form.argtypes = [count, place, place]
    library.eigensystems.argtypes = [count, count, place, real, *[place] * 3]
    library.cluster.argtypes = [*[count] * 5, *[place] * 4, *[real] * 4, place]
    library.peak_slopes.argtypes = [*[count] * 7, *[place] * 11]
    library.peaks.argtypes = [*[count] * 4, real, count, *[place] * 13]
    for name in ("spectra", "schur_form", "eigensystems", "cluster", "peak_slopes", "peaks"):
        getattr(library, name).restype = count
    return library


def compiled_eigenvalues(library: Library, A: FloatArray) -> ComplexArray | None:
    """Return the eigenvalues (m, n) of matrices (m, n, n); None if the QR iteration fails or memory runs out."""
    A, values = np.ascontiguousarray(A), np.empty(A.shape[:2], complex)
    return values if library.spectra(*values.shape, A.ctypes.data, values.ctypes.data) > 0 else None


def compiled_eigensystems(
    library: Library, A: FloatArray, longest: float
) -> tuple[ComplexArray, ComplexArray, ComplexArray] | None:
    """Return eigenvalues (m, n), right eigenvectors (columns) and left eigenvectors (rows); None on failure.

    The left eigenvectors of a defective matrix are no longer than `longest`; right eigenvectors have length one.
    """
    A, values = np.ascontiguousarray(A), np.empty(A.shape[:2], complex)
    right, left = np.empty(A.shape, complex), np.empty(A.shape, complex)
    addresses = values.ctypes.data, right.ctypes.data, left.ctypes.data
    converged = library.eigensystems(*values.shape, A.ctypes.data, longest, *addresses) > 0
    return (values, right, left) if converged else None


def compiled_schur_form(library: Library, A: FloatArray) -> ComplexArray | None:
    """Return the Schur form of a finite (n, n) matrix for `compiled_cluster`; None if the QR iteration fails."""
    n, A = len(A), np.ascontiguousarray(A)
    form = np.empty(2 * n * n + (n + 1) // 2 + n, complex)
    return form if library.schur_form(n, A.ctypes.data, form.ctypes.data) > 0 else None


def compiled_cluster(
    library: Library,
    form: ComplexArray,
    slopes: tuple[FloatArray, FloatArray, FloatArray],
    size: int,
    place: complex,
    rate: float,
    farthest: float,
) -> tuple[ComplexArray, ...] | None:
    """Return the cluster of eigenvalues nearest to a point: values, mean and power sums, with the gradients of both.

    Parameters
    ----------
    library : Library
        The kernels.
    form : complex array
        Schur form by `compiled_schur_form`.
    slopes : tuple of array
        Factors (n, p), (d, p, q) and (q, n) of the derivatives of the matrix.
    size : int
        Number k of eigenvalues, at most n.
    place : complex
        Place in the complex plane.
    rate : float
        Unit of distances.
    farthest : float
        Largest cotangent of the angle between the subspace and the others.

    Returns
    -------
    Arrays (k,), (1,), (d,), (k - 1,) and (k - 1, d); None when the subspace is not determined.
    """
    n, (d, p, q) = len(slopes[0]), slopes[1].shape
    out = np.empty(2 * size + size * d, complex)
    factors = [np.ascontiguousarray(factor) for factor in slopes]
    given = form.ctypes.data, *(factor.ctypes.data for factor in factors), place.real, place.imag, rate, farthest
    if not _found(library.cluster(n, d, size, p, q, *given, out.ctypes.data)):
        return None
    gradients = out[2 * size :].reshape(size, d)
    return out[:size], out[size : size + 1], gradients[0], out[size + 1 : 2 * size], gradients[1:]


def compiled_peak_slopes(
    library: Library, loops: Derivatives, first_row: int, loop: IntArray, frequency: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Return gradients (k, d) of the largest singular values of two by two responses, and the values (k,)."""
    k, (_, n_y, n), (_, d, p, q) = len(loop), loops.C.shape, loops.core.shape
    value, slope = np.empty(k), np.empty((k, d))
    matrices = loops.A, loops.B, loops.C, loops.D, loops.left, loops.core, loops.right
    arrays = [np.ascontiguousarray(array) for array in (loop, frequency, *matrices)]
    addresses = [array.ctypes.data for array in (*arrays, value, slope)]
    _found(library.peak_slopes(k, n, d, n_y, first_row, p, q, *addresses))
    return slope, value


def compiled_peaks(
    library: Library,
    response: tuple[ComplexArray, ComplexArray, FloatArray, dict[int, SchurResponse]],
    base: FloatArray,
    extra: tuple[IntArray, FloatArray] | None,
    least: float,
) -> tuple[IntArray, FloatArray, FloatArray]:
    """Return loop, frequency and height of the peaks of two by two responses (k,), see `find_peaks`.

    A response is poles (m, n), residues (m, n, 4), D, and the Schur forms of loops whose modes may have no use.
    """
    poles, residues, D, forms = response
    m, n = poles.shape
    loops, places = (np.zeros(0, np.intp), np.zeros(0)) if extra is None else extra
    most = m * (len(base) + 2 * n + len(places)) // 2 + m
    results = np.empty(most, np.intp), np.empty(most), np.empty(most)
    form_of, schur = np.full(m, -1), [np.zeros(0, complex)] * 3
    if forms:
        form_of[list(forms)] = np.arange(len(forms))
        schur = [np.array(parts) for parts in zip(*forms.values(), strict=True)]
    given = [np.ascontiguousarray(array) for array in (poles, residues, D, form_of, *schur, base)]
    extras = np.ascontiguousarray(loops, np.intp), np.ascontiguousarray(places, float)
    arrays = [array.ctypes.data for array in (*given, *extras, *results)]
    count = library.peaks(m, n, len(base), len(places), least, most, *arrays)
    _found(count)
    loop, place, height = (array[:count].copy() for array in results)
    return loop, place, height


def _found(ended: int) -> bool:
    if ended < 0:
        raise MemoryError("the kernels of the tuner got no memory")
    return ended > 0
