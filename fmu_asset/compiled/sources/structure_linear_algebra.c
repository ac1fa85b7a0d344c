#include "structure_linear_algebra.h"

#include <float.h>
#include <math.h>
#include <string.h>

#define MOST_SWEEPS 60

/* Also compiled for wider vector registers, and chosen when the library is loaded. The numbers are the same to the
   last bit, because each element is computed by the same operations in the same order. */
#if defined(__x86_64__) && defined(__gnu_linux__) && defined(__GLIBC__) && defined(__has_attribute)
#if __has_attribute(target_clones)
#define STRUCTURE_WIDE __attribute__((target_clones("avx2", "default")))
#endif
#endif
#ifndef STRUCTURE_WIDE
#define STRUCTURE_WIDE
#endif

void structure_add(double *restrict sum, size_t size, double factor, const double *restrict vector) {
    for (size_t i = 0; i < size; ++i) {
        sum[i] += factor * vector[i];
    }
}

STRUCTURE_WIDE
static void add_columns(double *restrict sum, size_t size, const double *restrict columns, size_t stride,
                        size_t count, const double *restrict coefficients) {
    size_t c = 0;
    for (; c + 4 <= count; c += 4) { /* four at a time, so that the sum is loaded and stored less often */
        const double *a = columns + c * stride, *b = a + stride, *d = b + stride, *e = d + stride;
        const double fa = coefficients[c], fb = coefficients[c + 1], fd = coefficients[c + 2],
                     fe = coefficients[c + 3];
        for (size_t i = 0; i < size; ++i) {
            sum[i] += (fa * a[i] + fb * b[i]) + (fd * d[i] + fe * e[i]);
        }
    }
    if (c + 2 <= count) {
        const double *a = columns + c * stride, *b = a + stride;
        const double fa = coefficients[c], fb = coefficients[c + 1];
        for (size_t i = 0; i < size; ++i) {
            sum[i] += fa * a[i] + fb * b[i];
        }
        c += 2;
    }
    if (c < count) {
        structure_add(sum, size, coefficients[c], columns + c * stride);
    }
}

void structure_add_columns(double *restrict sum, size_t size, const double *restrict columns, size_t stride,
                      size_t count, const double *restrict coefficients) {
    add_columns(sum, size, columns, stride, count, coefficients); /* the clones themselves would be exported */
}

STRUCTURE_WIDE
static double dot(const double *first, const double *second, size_t size) {
    /* Four sums that do not wait for each other. */
    double a = 0.0, b = 0.0, c = 0.0, d = 0.0;
    size_t i = 0;
    for (; i + 4 <= size; i += 4) {
        a += first[i] * second[i];
        b += first[i + 1] * second[i + 1];
        c += first[i + 2] * second[i + 2];
        d += first[i + 3] * second[i + 3];
    }
    for (; i < size; ++i) {
        a += first[i] * second[i];
    }
    return (a + b) + (c + d);
}

double structure_dot(const double *first, const double *second, size_t size) { return dot(first, second, size); }

double structure_norm(const double *vector, size_t size) { return sqrt(structure_dot(vector, vector, size)); }

void structure_multiply(double *restrict result, const double *restrict matrix, size_t rows, size_t size,
                   const double *restrict vector) {
    for (size_t i = 0; i < rows; ++i) {
        result[i] = structure_dot(matrix + i * size, vector, size);
    }
}

void structure_sum_terms(double *restrict result, size_t size, const double *restrict terms, size_t count,
                    const double *restrict theta) {
    memset(result, 0, size * size * sizeof *result);
    structure_add_columns(result, size * size, terms, size * size, count, theta);
}

bool structure_cholesky(double *matrix, size_t size) {
    for (size_t k = 0; k < size; ++k) {
        double *row = matrix + k * size;
        /* Column k of the factor, negative, moves to the lower triangle, where it lies in one piece. */
        for (size_t i = 0; i < k; ++i) {
            row[i] = -matrix[i * size + k];
        }
        structure_add_columns(row + k, size - k, matrix + k, size, k, row);
        if (!(row[k] > 0.0)) { /* also NaN */
            return false;
        }
        const double scale = 1.0 / sqrt(row[k]);
        row[k] = scale;
        for (size_t j = k + 1; j < size; ++j) {
            row[j] *= scale;
        }
    }
    return true;
}

void structure_solve_lower(const double *restrict factor, size_t size, double *restrict right) {
    for (size_t k = 0; k < size; ++k) {
        const double *row = factor + k * size;
        right[k] *= row[k];
        structure_add(right + k + 1, size - k - 1, -right[k], row + k + 1);
    }
}

void structure_solve_upper(const double *restrict factor, size_t size, double *restrict right) {
    for (size_t k = size; k-- > 0;) {
        const double *row = factor + k * size;
        right[k] = (right[k] - structure_dot(row + k + 1, right + k + 1, size - k - 1)) * row[k];
    }
}

STRUCTURE_WIDE
static void solve_lower_columns(const double *restrict factor, size_t size, double *restrict right) {
    for (size_t k = 0; k < size; ++k) {
        const double *row = factor + k * size;
        const double scale = row[k];
        double *solved = right + k * size;
        for (size_t j = 0; j < size; ++j) {
            solved[j] *= scale;
        }
        for (size_t i = k + 1; i < size; ++i) {
            double *restrict below = right + i * size;
            for (size_t j = 0; j < size; ++j) {
                below[j] -= row[i] * solved[j];
            }
        }
    }
}

void structure_solve_lower_columns(const double *restrict factor, size_t size, double *restrict right) {
    solve_lower_columns(factor, size, right);
}

/* Bring a symmetric matrix to tridiagonal form by Householder reflections H = I - factor v v' (Golub & Van Loan,
   Matrix Computations, section 8.3.1). Row k of the matrix then holds v from column k + 1 on. */
STRUCTURE_WIDE
static void tridiagonalise(double *restrict matrix, size_t size, double *restrict diagonal,
                           double *restrict off_diagonal, double *restrict factors, double *restrict work) {
    for (size_t k = 0; k + 1 < size; ++k) {
        double *v = matrix + k * size + k + 1;
        const size_t length = size - k - 1;
        const double norm = structure_norm(v, length);
        diagonal[k] = matrix[k * size + k];
        if (length == 1 || norm == 0.0) {
            off_diagonal[k] = v[0];
            factors[k] = 0.0;
            continue;
        }
        const double reflected = v[0] > 0.0 ? -norm : norm;
        off_diagonal[k] = reflected;
        /* (v', v) / 2 = norm (norm + |v0|), without a difference of like numbers */
        factors[k] = 1.0 / (norm * (norm + fabs(v[0])));
        v[0] -= reflected;
        for (size_t i = 0; i < length; ++i) {
            work[i] = factors[k] * structure_dot(matrix + (k + 1 + i) * size + k + 1, v, length);
        }
        structure_add(work, length, -0.5 * factors[k] * structure_dot(work, v, length), v);
        for (size_t i = 0; i < length; ++i) {
            double *row = matrix + (k + 1 + i) * size + k + 1;
            const double vi = v[i], wi = work[i];
            for (size_t j = 0; j < length; ++j) {
                row[j] -= vi * work[j] + wi * v[j];
            }
        }
    }
    diagonal[size - 1] = matrix[size * size - 1];
}

/* One implicit QR step with Wilkinson's shift on the block from `low` to `high` (ibid., algorithm 8.3.2), the
   rotations applied to the rows of `vectors` as well. */
STRUCTURE_WIDE
static void qr_step(double *restrict d, double *restrict e, size_t low, size_t high,
                    double *restrict vectors, size_t size) {
    const double gap = 0.5 * (d[high - 1] - d[high]), last = e[high - 1];
    const double root = sqrt(gap * gap + last * last);
    const double shift = d[high] - last * (last / (gap < 0.0 ? gap - root : gap + root));
    double x = d[low] - shift, z = e[low];
    for (size_t k = low; k < high; ++k) {
        const double length = sqrt(x * x + z * z);
        const double c = length > 0.0 ? x / length : 1.0, s = length > 0.0 ? z / length : 0.0;
        if (k > low) {
            e[k - 1] = length;
        }
        const double first = d[k], second = d[k + 1], between = e[k];
        const double change = s * (s * (second - first) + 2.0 * c * between);
        d[k] = first + change;
        d[k + 1] = second - change;
        e[k] = (c - s) * (c + s) * between + c * s * (second - first);
        if (k + 1 < high) {
            x = e[k];
            z = s * e[k + 1];
            e[k + 1] *= c;
        }
        double *upper = vectors + k * size, *lower = upper + size;
        for (size_t j = 0; j < size; ++j) {
            const double above = upper[j], below = lower[j];
            upper[j] = c * above + s * below;
            lower[j] = c * below - s * above;
        }
    }
}

bool structure_symmetric_eigen(double *restrict matrix, size_t size, double *restrict values,
                          double *restrict vectors, double *restrict work) {
    double *off_diagonal = work, *factors = work + size;
    tridiagonalise(matrix, size, values, off_diagonal, factors, work + 2 * size);
    /* The product of the reflections, transposed: the last ones concern only the last rows and columns. */
    memset(vectors, 0, size * size * sizeof *vectors);
    for (size_t i = 0; i < size; ++i) {
        vectors[i * size + i] = 1.0;
    }
    for (size_t k = size - 1; k-- > 0;) {
        const double *v = matrix + k * size + k + 1;
        for (size_t i = k + 1; i < size && factors[k] != 0.0; ++i) {
            double *row = vectors + i * size + k + 1;
            structure_add(row, size - k - 1, -factors[k] * structure_dot(row, v, size - k - 1), v);
        }
    }
    size_t high = size - 1, sweeps = 0;
    while (high > 0) {
        size_t low = high;
        while (low > 0) {
            const double beside = fabs(values[low - 1]) + fabs(values[low]);
            if (fabs(off_diagonal[low - 1]) <= 0.5 * DBL_EPSILON * beside + DBL_MIN) {
                off_diagonal[low - 1] = 0.0;
                break;
            }
            --low;
        }
        if (low == high) {
            --high;
            sweeps = 0;
        } else if (++sweeps > MOST_SWEEPS) {
            return false;
        } else {
            qr_step(values, off_diagonal, low, high, vectors, size);
        }
    }
    return true;
}
