"""C source of the kernels of eigenvalues and Schur forms; it follows that of the gradients."""

from __future__ import annotations

SCHUR = r"""
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

/* Eigenvalues of a matrix, and for each of some places the mean of the nearest ones and their power sums; 0: it fails.
   A place is given as real and imaginary part, unit of distances and number of eigenvalues. */
long near_sums(long n, const double *A, long count, const double (*place)[4], num *value)
{
    num *out = value + n;
    double *work = malloc((n * n + 4 * n) * sizeof(double));
    long *order = malloc(n * sizeof(long));
    if (!work || !order) {
        free(work), free(order);
        return -1;
    }
    memcpy(work, A, n * n * sizeof(double));
    balance(n, work, work + n * n);
    to_hessenberg(n, work, 0, work + n * n);
    long ended = francis(n, work, 0, value);
    for (long c = 0; ended && c < count; c++) {
        long k = place[c][3];
        double rate = place[c][2];
        nearest(n, value, (num){place[c][0], place[c][1]}, work, order);
        num centre = {0.0, 0.0};
        for (long i = 0; i < k; i++) centre.re += value[order[i]].re / k, centre.im += value[order[i]].im / k;
        num *sum = out + 1;
        *out = centre, out += k;
        for (long j = 0; j + 1 < k; j++) sum[j] = (num){0.0, 0.0};
        for (long i = 0; i < k; i++) {
            num off = {(value[order[i]].re - centre.re) / rate, (value[order[i]].im - centre.im) / rate};
            num power = off;
            for (long j = 0; j + 1 < k; j++)
                power = times(power, off), sum[j].re += power.re / k, sum[j].im += power.im / k;
        }
    }
    free(work), free(order);
    return ended;
}
"""
