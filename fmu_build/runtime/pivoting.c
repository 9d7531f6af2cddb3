/* Sparse factorisation with pivots chosen by size. */
#include <math.h>
#include <stdlib.h>
#include <string.h>

#include "linear.h"

void free_pivoted(Pivoted **f) {
    if (!*f) return;
    for (int i = 0; i < 2; i++) {
        free((*f)->start[i]);
        free((*f)->row[i]);
        free((*f)->value[i]);
    }
    free((*f)->pivot);
    free((*f)->diagonal);
    free(*f);
    *f = NULL;
}

static Pivoted *new_pivoted(int n) {
    Pivoted *f = calloc(1, sizeof *f);
    if (!f) return NULL;
    for (int i = 0; i < 2; i++) f->start[i] = malloc((size_t)(n + 1) * sizeof(int));
    f->pivot = malloc((size_t)n * sizeof(int));
    f->diagonal = malloc((size_t)n * sizeof(double));
    if (!f->start[0] || !f->start[1] || !f->pivot || !f->diagonal) free_pivoted(&f);
    return f;
}

/* Room for n more entries of L (which = 0) or U (1) after `used` ones. */
static int make_room(Pivoted *f, int which, int used, int n) {
    if (used + n <= f->room[which]) return 0;
    const int room = 2 * used + n + 64;
    int *row = realloc(f->row[which], (size_t)room * sizeof *row);
    if (row) f->row[which] = row;
    double *value = realloc(f->value[which], (size_t)room * sizeof *value);
    if (value) f->value[which] = value;
    if (!row || !value) return 1;
    f->room[which] = room;
    return 0;
}

/* Column by column in the given order; the pivot is the largest entry in proportion to its row. */
int pivoted_factor(int n, const int *start, const int *row, const int *column, const double *a, Pivoted **to) {
    if (!*to) *to = new_pivoted(n);
    Pivoted *f = *to;
    double *x = calloc((size_t)n, sizeof *x), *scale = calloc((size_t)n, sizeof *scale);
    char *taken = calloc((size_t)n, 1);
    int failed = !f || !x || !scale || !taken, used[2] = {0, 0};
    for (int k = 0; !failed && k < start[n]; k++) scale[row[k]] = fmax(scale[row[k]], fabs(a[k]));
    for (int k = 0; !failed && k < n; k++) {
        f->start[0][k] = used[0];
        f->start[1][k] = used[1];
        if (make_room(f, 0, used[0], n) || make_room(f, 1, used[1], n)) {
            failed = 1;
            break;
        }
        for (int q = start[column[k]]; q < start[column[k] + 1]; q++) x[row[q]] = a[q];
        for (int j = 0; j < k; j++) {
            const double u = x[f->pivot[j]];
            if (u == 0.0) continue;
            f->row[1][used[1]] = j;
            f->value[1][used[1]++] = u;
            for (int r = f->start[0][j]; r < f->start[0][j + 1]; r++) x[f->row[0][r]] -= f->value[0][r] * u;
        }
        int best = -1;
        double largest = 0.0;
        for (int i = 0; i < n; i++)
            if (!taken[i] && fabs(x[i]) > largest * scale[i]) best = i, largest = fabs(x[i]) / scale[i];
        failed = best < 0 || !isfinite(x[best]);
        if (failed) break;
        taken[best] = 1;
        f->pivot[k] = best;
        f->diagonal[k] = 1.0 / x[best];
        for (int i = 0; i < n; i++)
            if (!taken[i] && x[i] != 0.0) {
                f->row[0][used[0]] = i;
                f->value[0][used[0]++] = x[i] * f->diagonal[k];
            }
        f->start[0][k + 1] = used[0];
        f->start[1][k + 1] = used[1];
        memset(x, 0, (size_t)n * sizeof *x);
    }
    free(x);
    free(scale);
    free(taken);
    return failed;
}

void pivoted_solve(int n, const int *column, const Pivoted *f, double *work, double *b) {
    for (int k = 0; k < n; k++) {
        const double v = work[k] = b[f->pivot[k]];
        for (int r = f->start[0][k]; r < f->start[0][k + 1]; r++) b[f->row[0][r]] -= f->value[0][r] * v;
    }
    for (int k = n - 1; k >= 0; k--) {
        const double v = work[k] *= f->diagonal[k];
        for (int q = f->start[1][k]; q < f->start[1][k + 1]; q++) work[f->row[1][q]] -= f->value[1][q] * v;
    }
    for (int k = 0; k < n; k++) b[column[k]] = work[k];
}
