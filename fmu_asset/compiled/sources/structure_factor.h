/* The Cholesky factor for registers that hold WIDTH numbers, named by IN_LANES; included once for each width. Each
   number is computed by the same operations in the same order for any width, and is the same to the last bit. */

#define VECTOR IN_LANES(vector)
#if WIDTH > 1
typedef double VECTOR __attribute__((vector_size(WIDTH * sizeof(double)), aligned(sizeof(double)), may_alias));
#else
typedef double VECTOR;
#endif
#define AT(place) (*(VECTOR *)(void *)(place))
#define OF(place) (*(const VECTOR *)(const void *)(place))

/* Four rows at a time: what earlier rows take from them, the factor of the four by four numbers on the diagonal, in
   which divisions alone wait for each other, and what the four take from each other. */
TARGET static bool IN_LANES(factorise)(double *factor, size_t size, size_t stride, const double *base,
                                       const double *terms, size_t count, const double *theta) {
    const size_t rows = structure_padded(size), room = rows * stride;
    for (size_t k = 0; k < rows; k += 4) {
        double *p = factor + k * stride, *q = p + stride, *r = q + stride, *s = r + stride;
        size_t j = k;
        for (; j + 2 * WIDTH <= stride; j += 2 * WIDTH) {
            const double *from = base + k * stride + j;
            VECTOR a = OF(from), b = OF(from + stride), c = OF(from + 2 * stride), d = OF(from + 3 * stride);
            from += WIDTH;
            VECTOR e = OF(from), f = OF(from + stride), g = OF(from + 2 * stride), h = OF(from + 3 * stride);
            for (size_t t = 0; t < count; ++t) {
                from = terms + t * room + k * stride + j;
                a += theta[t] * OF(from), b += theta[t] * OF(from + stride);
                c += theta[t] * OF(from + 2 * stride), d += theta[t] * OF(from + 3 * stride);
                from += WIDTH;
                e += theta[t] * OF(from), f += theta[t] * OF(from + stride);
                g += theta[t] * OF(from + 2 * stride), h += theta[t] * OF(from + 3 * stride);
            }
            const double *left = factor + k, *row = factor + j;
            for (size_t i = 0; i < k; ++i, left += stride, row += stride) {
                const VECTOR x = OF(row), y = OF(row + WIDTH);
                a -= left[0] * x, e -= left[0] * y;
                b -= left[1] * x, f -= left[1] * y;
                c -= left[2] * x, g -= left[2] * y;
                d -= left[3] * x, h -= left[3] * y;
            }
            AT(p + j) = a, AT(q + j) = b, AT(r + j) = c, AT(s + j) = d;
            AT(p + j + WIDTH) = e, AT(q + j + WIDTH) = f, AT(r + j + WIDTH) = g, AT(s + j + WIDTH) = h;
        }
        for (; j < stride; j += WIDTH) {
            const double *from = base + k * stride + j;
            VECTOR a = OF(from), b = OF(from + stride), c = OF(from + 2 * stride), d = OF(from + 3 * stride);
            for (size_t t = 0; t < count; ++t) {
                from = terms + t * room + k * stride + j;
                a += theta[t] * OF(from), b += theta[t] * OF(from + stride);
                c += theta[t] * OF(from + 2 * stride), d += theta[t] * OF(from + 3 * stride);
            }
            const double *left = factor + k, *row = factor + j;
            for (size_t i = 0; i < k; ++i, left += stride, row += stride) {
                const VECTOR x = OF(row);
                a -= left[0] * x, b -= left[1] * x, c -= left[2] * x, d -= left[3] * x;
            }
            AT(p + j) = a, AT(q + j) = b, AT(r + j) = c, AT(s + j) = d;
        }
        const double a = p[k], ia = 1.0 / a, ab = p[k + 1], ac = p[k + 2], ad = p[k + 3];
        const double lab = ab * ia, lac = ac * ia, lad = ad * ia;
        const double b = q[k + 1] - lab * ab, ib = 1.0 / b, bc = q[k + 2] - lab * ac, bd = q[k + 3] - lab * ad;
        const double lbc = bc * ib, lbd = bd * ib;
        const double c = (r[k + 2] - lac * ac) - lbc * bc, ic = 1.0 / c, cd = (r[k + 3] - lac * ad) - lbc * bd;
        const double lcd = cd * ic, d = ((s[k + 3] - lad * ad) - lbd * bd) - lcd * cd, id = 1.0 / d;
        if (!(a > 0.0 && b > 0.0 && c > 0.0 && d > 0.0)) { /* also NaN */
            return false;
        }
        const double sa = sqrt(a) * ia, sb = sqrt(b) * ib, sc = sqrt(c) * ic, sd = sqrt(d) * id;
        for (j = k; j < stride; j += WIDTH) {
            const VECTOR first = OF(p + j), second = OF(q + j) - lab * first;
            const VECTOR third = (OF(r + j) - lac * first) - lbc * second;
            const VECTOR fourth = ((OF(s + j) - lad * first) - lbd * second) - lcd * third;
            AT(p + j) = sa * first;
            AT(q + j) = sb * second;
            AT(r + j) = sc * third;
            AT(s + j) = sd * fourth;
        }
        for (j = k + 4; j < rows; ++j) {
            double *column = factor + j * stride + k;
            column[0] = -p[j], column[1] = -q[j], column[2] = -r[j], column[3] = -s[j];
        }
        p[k] = sa, q[k + 1] = sb, r[k + 2] = sc, s[k + 3] = sd;
        q[k] = -p[k + 1], r[k] = -p[k + 2], s[k] = -p[k + 3];
        r[k + 1] = -q[k + 2], s[k + 1] = -q[k + 3], s[k + 2] = -r[k + 3];
    }
    return true;
}

TARGET static void IN_LANES(solve_upper)(const double *factor, size_t size, size_t stride, double *right) {
    size_t k = size;
    while (k % 4 > 0) {
        const double *row = factor + --k * stride, found = right[k] * row[k];
        right[k] = found;
        for (size_t i = 0; i < k; ++i) { /* column k, negative */
            right[i] += found * row[i];
        }
    }
    while (k > 0) {
        k -= 4;
        const double *p = factor + k * stride, *q = p + stride, *r = q + stride, *s = r + stride;
        double *x = right + k;
        const double d = x[3] * s[k + 3], c = (x[2] + d * s[k + 2]) * r[k + 2];
        const double b = ((x[1] + d * s[k + 1]) + c * r[k + 1]) * q[k + 1];
        const double a = (((x[0] + d * s[k]) + c * r[k]) + b * q[k]) * p[k];
        x[0] = a, x[1] = b, x[2] = c, x[3] = d;
        for (size_t i = 0; i < k; i += WIDTH) {
            AT(right + i) += (a * OF(p + i) + b * OF(q + i)) + (c * OF(r + i) + d * OF(s + i));
        }
    }
}

/* Apply a reflection, row -= v[i] w + w[i] v, to rows of a symmetric matrix, of which the columns from `begin` are in use,
   and multiply what they then are by the next one: product += next[i] row. So each row is read once. */
TARGET static void IN_LANES(reflect_rows)(double *restrict matrix, size_t stride, size_t first, size_t last,
                                          size_t begin, const double *restrict v, const double *restrict w,
                                          const double *restrict next, double *restrict product) {
    size_t i = first;
    if ((last - i) % 2 > 0) {
        double *p = matrix + i * stride;
        const double vp = v[i], wp = w[i], np = next[i++];
        for (size_t j = begin; j < stride; j += WIDTH) {
            const VECTOR a = OF(p + j) - (vp * OF(w + j) + wp * OF(v + j));
            AT(p + j) = a;
            AT(product + j) += np * a;
        }
    }
    for (; i < last; i += 2) {
        double *p = matrix + i * stride, *q = p + stride;
        const double vp = v[i], wp = w[i], np = next[i], vq = v[i + 1], wq = w[i + 1], nq = next[i + 1];
        for (size_t j = begin; j < stride; j += WIDTH) {
            const VECTOR x = OF(v + j), y = OF(w + j);
            const VECTOR a = OF(p + j) - (vp * y + wp * x), b = OF(q + j) - (vq * y + wq * x);
            AT(p + j) = a, AT(q + j) = b;
            AT(product + j) += np * a + nq * b;
        }
    }
}

/* Apply the reflections of `tridiagonalise`, the last one first, to vectors side by side: z (size, LANES). */
TARGET static void IN_LANES(reflect)(double *restrict z, const double *restrict matrix, size_t size, size_t stride,
                                     const double *restrict factors) {
    for (size_t lane = 0; lane < LANES; lane += WIDTH) {
        for (size_t k = size - 1; k-- > 0;) {
            const double *v = matrix + k * stride;
            double *x = z + (k + 1) * LANES + lane;
            size_t i = k + 1;
            VECTOR even = v[i] * OF(x), odd = 0.0 * even; /* which do not wait for each other */
            for (++i, x += LANES; i + 2 <= size; i += 2, x += 2 * LANES) {
                even += v[i] * OF(x);
                odd += v[i + 1] * OF(x + LANES);
            }
            if (i < size) {
                even += v[i] * OF(x);
            }
            even = factors[k] * (even + odd);
            for (i = k + 1, x = z + i * LANES + lane; i < size; ++i, x += LANES) {
                AT(x) -= v[i] * even;
            }
        }
    }
}

/* sum += columns times coefficients, in the registers of one or several vectors: four columns at a time */
#define SUM(place, c) ((fa * OF(a + place) + fb * OF(b + place)) + (fc * OF(c + place) + fd * OF(d + place)))

TARGET static void IN_LANES(add_columns)(double *sum, size_t size, const double *columns, size_t stride, size_t count,
                                         const double *factors) {
    size_t i = 0;
    for (; i + 4 * WIDTH <= size; i += 4 * WIDTH) {
        VECTOR p = OF(sum + i), q = OF(sum + i + WIDTH), r = OF(sum + i + 2 * WIDTH), s = OF(sum + i + 3 * WIDTH);
        const double *a = columns + i;
        size_t k = 0;
        for (; k + 4 <= count; k += 4, a += 4 * stride) {
            const double *b = a + stride, *c = b + stride, *d = c + stride;
            const double fa = factors[k], fb = factors[k + 1], fc = factors[k + 2], fd = factors[k + 3];
            p += SUM(0, c), q += SUM(WIDTH, c), r += SUM(2 * WIDTH, c), s += SUM(3 * WIDTH, c);
        }
        for (; k < count; ++k, a += stride) {
            p += factors[k] * OF(a), q += factors[k] * OF(a + WIDTH);
            r += factors[k] * OF(a + 2 * WIDTH), s += factors[k] * OF(a + 3 * WIDTH);
        }
        AT(sum + i) = p, AT(sum + i + WIDTH) = q, AT(sum + i + 2 * WIDTH) = r, AT(sum + i + 3 * WIDTH) = s;
    }
    for (; i + WIDTH <= size; i += WIDTH) {
        VECTOR p = OF(sum + i);
        const double *a = columns + i;
        size_t k = 0;
        for (; k + 4 <= count; k += 4, a += 4 * stride) {
            const double *b = a + stride, *c = b + stride, *d = c + stride;
            const double fa = factors[k], fb = factors[k + 1], fc = factors[k + 2], fd = factors[k + 3];
            p += SUM(0, c);
        }
        for (; k < count; ++k, a += stride) {
            p += factors[k] * OF(a);
        }
        AT(sum + i) = p;
    }
    for (; i < size; ++i) {
        double p = sum[i];
        const double *a = columns + i;
        size_t k = 0;
        for (; k + 4 <= count; k += 4, a += 4 * stride) {
            p += (factors[k] * a[0] + factors[k + 1] * a[stride]) +
                 (factors[k + 2] * a[2 * stride] + factors[k + 3] * a[3 * stride]);
        }
        for (; k < count; ++k, a += stride) {
            p += factors[k] * *a;
        }
        sum[i] = p;
    }
}

#undef AT
#undef OF
#undef VECTOR
