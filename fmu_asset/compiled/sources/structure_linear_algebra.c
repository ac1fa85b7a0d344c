#include "structure_linear_algebra.h"

#include <float.h>
#include <math.h>
#include <string.h>

#define MOST_SWEEPS 60
#define LANES 8
/* These loops stay loops until the compiler has put what is side by side into one register. */
#if defined(__GNUC__) && !defined(__clang__)
#define OVER_LANES _Pragma("GCC unroll 1") for (size_t j = 0; j < LANES; ++j)
#else
#define OVER_LANES for (size_t j = 0; j < LANES; ++j)
#endif
/* Eigenvalues that lie closer, relative to their size, have vectors that single iterations do not keep apart. */
#define LEAST_GAP 0.05
#define MOST_CORRECTIONS 10
/* The largest correction of a value, relative to it, after which its vector is taken: one of rounding, since the next
   would be about the third power. */
#define SETTLED 1e-12

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

static inline double inline_dot(const double *first, const double *second, size_t size) {
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

STRUCTURE_WIDE
static double dot(const double *first, const double *second, size_t size) { return inline_dot(first, second, size); }

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

/* Compiled for the registers that every processor has, and for wider ones where they are. */
#define TARGET
#define IN_LANES(name) name##_narrow
#if defined(__GNUC__)
#define WIDTH 2
#else
#define WIDTH 1
#endif
#include "structure_factor.h"
#define CHOOSE(name) name##_narrow
#if defined(__GNUC__) && defined(__x86_64__) && !defined(_WIN32)
#undef TARGET
#undef IN_LANES
#undef WIDTH
#undef CHOOSE
#define TARGET __attribute__((target("avx2")))
#define IN_LANES(name) name##_wide
#define WIDTH 4
#include "structure_factor.h"
#define CHOOSE(name) (__builtin_cpu_supports("avx2") ? name##_wide : name##_narrow)
#endif

void structure_add_columns(double *restrict sum, size_t size, const double *restrict columns, size_t stride,
                           size_t count, const double *restrict coefficients) {
    CHOOSE(add_columns)(sum, size, columns, stride, count, coefficients);
}

size_t structure_padded(size_t size) { return (size + 3) / 4 * 4; }

bool structure_cholesky(double *factor, size_t size, size_t stride, const double *base, const double *terms,
                        size_t count, const double *theta) {
    return CHOOSE(factorise)(factor, size, stride, base, terms, count, theta);
}

void structure_pad(double *padded, const double *matrix, size_t size) {
    const size_t stride = structure_padded(size);
    for (size_t i = 0; i < stride; ++i, padded += stride) {
        const size_t kept = i < size ? size : 0;
        memcpy(padded, matrix + i * kept, kept * sizeof *matrix);
        memset(padded + kept, 0, (stride - kept) * sizeof *padded);
        padded[i] = i < size ? padded[i] : 1.0;
    }
}

STRUCTURE_WIDE
static void solve_lower(const double *restrict factor, size_t size, size_t stride, double *restrict right) {
    for (size_t k = 0; k < size; ++k) {
        const double *row = factor + k * stride, found = right[k] * row[k];
        right[k] = found;
        for (size_t i = k + 1; i < size; ++i) {
            right[i] -= found * row[i];
        }
    }
}

void structure_solve_lower(const double *restrict factor, size_t size, size_t stride, double *restrict right) {
    solve_lower(factor, size, stride, right);
}

void structure_solve_upper(const double *restrict factor, size_t size, size_t stride, double *restrict right) {
    CHOOSE(solve_upper)(factor, size, stride, right);
}

STRUCTURE_WIDE
static void solve_lower_columns(const double *restrict factor, size_t size, size_t stride, double *restrict right) {
    for (size_t k = 0; k < size; ++k) {
        const double *row = factor + k * stride;
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

void structure_solve_lower_columns(const double *restrict factor, size_t size, size_t stride, double *restrict right) {
    solve_lower_columns(factor, size, stride, right);
}

/* Bring a symmetric matrix with padded rows to tridiagonal form by Householder reflections H = I - factor v v' (Golub &
   Van Loan, Matrix Computations, section 8.3.1). Row k of the matrix then holds v from column k + 1 on. `work` has room
   for three rows. */
STRUCTURE_WIDE
static void tridiagonalise(double *restrict matrix, size_t size, double *restrict diagonal,
                           double *restrict off_diagonal, double *restrict factors, double *restrict work) {
    const size_t stride = structure_padded(size);
    double *w = work, *product = w + stride;
    const double *v = product + stride; /* none at first */
    memset(work, 0, 3 * stride * sizeof *work);
    for (size_t k = 0; k + 1 < size; ++k) {
        double *row = matrix + k * stride, *x = row + k + 1;
        const size_t length = size - k - 1, begin = (k + 1) / 4 * 4;
        for (size_t j = k; j < size; ++j) {
            row[j] -= v[k] * w[j] + w[k] * v[j];
        }
        diagonal[k] = row[k];
        const double norm = sqrt(inline_dot(x, x, length));
        off_diagonal[k] = x[0];
        factors[k] = 0.0;
        if (length > 1 && norm > 0.0) {
            off_diagonal[k] = x[0] > 0.0 ? -norm : norm;
            /* (v', v) / 2 = norm (norm + |v0|), without a difference of like numbers */
            factors[k] = 1.0 / (norm * (norm + fabs(x[0])));
            x[0] -= off_diagonal[k];
        }
        memset(row + begin, 0, (k + 1 - begin) * sizeof *row); /* in front of it, so that loops may begin there */
        memset(product, 0, stride * sizeof *product);
        CHOOSE(reflect_rows)(matrix, stride, k + 1, size, begin, v, w, row, product);
        const double share = -0.5 * factors[k] * factors[k] * inline_dot(product + k + 1, x, length);
        memset(w + begin, 0, (k + 1 - begin) * sizeof *w);
        for (size_t j = k + 1; j < stride; ++j) {
            w[j] = factors[k] * product[j] + share * row[j];
        }
        v = row;
    }
    diagonal[size - 1] = matrix[(size - 1) * stride + size - 1];
}

/* Apply the reflections of `tridiagonalise` to vectors (count, size); `work` has room for size LANES doubles. */
static void reflect(double *vectors, size_t count, const double *matrix, size_t size, const double *factors,
                    double *work) {
    for (size_t first = 0; first < count; first += LANES, vectors += LANES * size) {
        const size_t lanes = count - first < LANES ? count - first : LANES;
        for (size_t i = 0; i < size; ++i) {
            for (size_t j = 0; j < LANES; ++j) {
                work[i * LANES + j] = j < lanes ? vectors[j * size + i] : 0.0;
            }
        }
        CHOOSE(reflect)(work, matrix, size, structure_padded(size), factors);
        for (size_t i = 0; i < size; ++i) {
            for (size_t j = 0; j < lanes; ++j) {
                vectors[j * size + i] = work[i * LANES + j];
            }
        }
    }
}

/* Correct approximate eigenvalues x of a tridiagonal matrix, one in each lane, and find their vectors z (size, LANES)
   with squares of their lengths: T - x is factorised from both ends, the vector is one where these meet with the
   least remainder, and the Rayleigh quotient of it is the next x (Dhillon and Parlett, "Orthogonal eigenvectors and
   relative gaps", SIAM J. Matrix Anal. Appl. 25, 2004). `work` has room for 4 size LANES doubles. */
STRUCTURE_WIDE
static void correct(const double *restrict d, const double *restrict e, size_t size, double *restrict x,
                    double *restrict change, double *restrict z, double *restrict square, double *restrict work) {
    double *restrict up = work, *restrict down = up + size * LANES;
    double *restrict above = down + size * LANES, *restrict below = above + size * LANES;
    const double tiny = DBL_EPSILON * DBL_EPSILON * fabs(d[0]) + DBL_MIN;
    double top[LANES], bottom[LANES], least[LANES], remainder[LANES], place[LANES];
    OVER_LANES {
        top[j] = bottom[j] = 1.0;
        least[j] = DBL_MAX;
        remainder[j] = place[j] = square[j] = 0.0;
    }
    /* Both ends at once, so that their divisions do not wait for each other; and no branches in loops over lanes. */
    for (size_t i = 0, k = size - 1; i < size; ++i, --k) {
        const double before = i == 0 ? 0.0 : e[i - 1], behind = i == 0 ? 0.0 : e[k];
        OVER_LANES {
            const double of_top = before / top[j], of_bottom = behind / bottom[j];
            above[i * LANES + j] = of_top;
            below[k * LANES + j] = of_bottom;
            top[j] = (d[i] - x[j]) - before * of_top;
            bottom[j] = (d[k] - x[j]) - behind * of_bottom;
        }
        OVER_LANES {
            top[j] = fabs(top[j]) <= tiny ? tiny : top[j];
            bottom[j] = fabs(bottom[j]) <= tiny ? tiny : bottom[j];
            up[i * LANES + j] = top[j];
            down[k * LANES + j] = bottom[j];
        }
    }
    for (size_t i = 0; i < size; ++i) {
        const double here = (double)i;
        OVER_LANES {
            const double left = up[i * LANES + j] + (down[i * LANES + j] - (d[i] - x[j]));
            const bool better = fabs(left) < least[j];
            least[j] = better ? fabs(left) : least[j];
            remainder[j] = better ? left : remainder[j];
            place[j] = better ? here : place[j];
        }
    }
    OVER_LANES {
        top[j] = bottom[j] = 0.0;
    }
    for (size_t i = size - 1, k = 0; k < size; --i, ++k) { /* from the place backwards, and onwards */
        const double here = (double)i, there = (double)k;
        OVER_LANES {
            top[j] = here == place[j] ? 1.0 : top[j];
            bottom[j] = there == place[j] ? 1.0 : bottom[j];
        }
        OVER_LANES {
            z[i * LANES + j] = top[j];
            down[k * LANES + j] = there == place[j] ? 0.0 : bottom[j];
            top[j] *= -above[i * LANES + j]; /* nothing lies above the first, and nothing below the last */
            bottom[j] *= -below[k * LANES + j];
        }
    }
    for (size_t i = 0; i < size; ++i) {
        OVER_LANES {
            const double kept = z[i * LANES + j] + down[i * LANES + j];
            z[i * LANES + j] = kept;
            square[j] += kept * kept;
        }
    }
    OVER_LANES {
        change[j] = remainder[j] / square[j];
        x[j] += change[j];
    }
}

/* How many eigenvalues of a tridiagonal matrix are less than x: Sylvester's law of inertia. */
static size_t count_below(const double *d, const double *e, size_t size, double x) {
    double pivot = d[0] - x;
    size_t count = pivot < 0.0;
    for (size_t i = 1; i < size; ++i) {
        pivot = (d[i] - x) - e[i - 1] * e[i - 1] / (pivot == 0.0 ? DBL_MIN : pivot);
        count += pivot < 0.0;
    }
    return count;
}

static void swap(double *first, double *second, size_t size) {
    for (size_t i = 0; i < size; ++i) {
        const double kept = first[i];
        first[i] = second[i];
        second[i] = kept;
    }
}

/* Put the `count` smallest values first, ascending, and their vectors. */
static void sort_pairs(double *values, double *vectors, size_t all, size_t count, size_t size) {
    for (size_t i = 0; i < count; ++i) {
        size_t least = i;
        for (size_t j = i + 1; j < all; ++j) {
            least = values[j] < values[least] ? j : least;
        }
        if (least != i) {
            swap(values + i, values + least, 1);
            swap(vectors + i * size, vectors + least * size, size);
        }
    }
}

/* The lowest eigenpairs of a positive definite tridiagonal matrix from values nearby; false if one is not found or
   they lie too close to each other or to the next one. */
static bool find_apart(const double *d, const double *e, size_t size, size_t count, double *values, double *vectors,
                       double *work) {
    double x[LANES], change[LANES], square[LANES], *z = work;
    for (size_t first = 0; first < count; first += LANES) {
        const size_t lanes = count - first < LANES ? count - first : LANES;
        for (size_t j = 0; j < LANES; ++j) {
            x[j] = values[first + (j < lanes ? j : 0)];
        }
        bool settled = false;
        for (size_t turn = 0; turn < MOST_CORRECTIONS && !settled; ++turn) {
            correct(d, e, size, x, change, z, square, work + size * LANES);
            settled = true;
            for (size_t j = 0; j < LANES; ++j) {
                settled = settled && fabs(change[j]) <= SETTLED * x[j]; /* also not if x is not positive */
            }
        }
        if (!settled) {
            return false;
        }
        for (size_t j = 0; j < lanes; ++j) {
            const double scale = 1.0 / sqrt(square[j]);
            values[first + j] = x[j];
            for (size_t i = 0; i < size; ++i) {
                vectors[(first + j) * size + i] = scale * z[i * LANES + j];
            }
        }
    }
    sort_pairs(values, vectors, count, count, size);
    for (size_t i = 1; i < count; ++i) {
        if (values[i] < (1.0 + LEAST_GAP) * values[i - 1]) {
            return false;
        }
    }
    return count_below(d, e, size, (1.0 + LEAST_GAP) * values[count - 1]) == count;
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

/* All eigenpairs of a tridiagonal matrix, the diagonal becoming the eigenvalues. */
static bool find_all(double *values, double *off_diagonal, size_t size, double *vectors) {
    memset(vectors, 0, size * size * sizeof *vectors);
    for (size_t i = 0; i < size; ++i) {
        vectors[i * size + i] = 1.0;
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

bool structure_symmetric_eigen(const double *restrict matrix, size_t size, size_t count, double *restrict values,
                               double *restrict vectors, double *restrict work) {
    double *padded = work, *rest = padded + structure_padded(size) * structure_padded(size);
    double *diagonal = rest + 40 * size + 12, *off_diagonal = diagonal + size, *factors = off_diagonal + size;
    for (size_t i = 0; i < size; ++i) {
        values[i] = matrix[i * size + i];
    }
    for (size_t i = 0; i < count; ++i) { /* the least of the diagonal, from which the lowest are looked for */
        for (size_t j = i + 1; j < size; ++j) {
            if (values[j] < values[i]) {
                swap(values + i, values + j, 1);
            }
        }
    }
    structure_pad(padded, matrix, size);
    tridiagonalise(padded, size, diagonal, off_diagonal, factors, rest);
    if (count == size || !find_apart(diagonal, off_diagonal, size, count, values, vectors, rest)) {
        memcpy(values, diagonal, size * sizeof *values);
        if (!find_all(values, off_diagonal, size, vectors)) {
            return false;
        }
        sort_pairs(values, vectors, size, count, size);
    }
    reflect(vectors, count, padded, size, factors, rest);
    return true;
}
