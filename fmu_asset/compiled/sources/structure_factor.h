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

#undef AT
#undef OF
#undef VECTOR
