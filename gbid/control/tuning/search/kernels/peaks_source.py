"""C source of a kernel: peaks of the largest singular value of two by two responses."""

from __future__ import annotations

PEAKS = r"""
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
long peaks(long m, long n, const num *pole, const num *residue, const double *D, const long *form_of, const num *form,
           const num *inputs, const num *outputs, long n_base, const double *base, long n_extra, const long *extra_loop,
           const double *extra_w, double least, long most, long *loop, double *place, double *height)
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
            double size = sqrt(square(p[k]));
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
