/* Dense linear algebra of a few dozen unknowns. Matrices are row by row; what is written overlaps with nothing. */
#ifndef STRUCTURE_LINEAR_ALGEBRA_H
#define STRUCTURE_LINEAR_ALGEBRA_H

#include "structure_common.h"

#if defined(__GNUC__) && !defined(_WIN32)
#pragma GCC visibility push(hidden)
#endif

/* sum += factor * vector */
void structure_add(double *restrict sum, size_t size, double factor, const double *restrict vector);

/* sum += sum over c of coefficient[c] * column[c]; a column of `size` numbers begins `stride` after the last one */
void structure_add_columns(double *restrict sum, size_t size, const double *restrict columns, size_t stride,
                      size_t count, const double *restrict coefficients);

double structure_dot(const double *first, const double *second, size_t size);

double structure_norm(const double *vector, size_t size);

/* result = matrix (rows, size) times vector */
void structure_multiply(double *restrict result, const double *restrict matrix, size_t rows, size_t size,
                   const double *restrict vector);

/* result = sum over the terms of theta[k] * terms[k], of matrices (size, size) one after another */
void structure_sum_terms(double *restrict result, size_t size, const double *restrict terms, size_t count,
                    const double *restrict theta);

/* A size that registers divide. */
size_t structure_padded(size_t size);

/* Copy a matrix (size, size) into one of the padded size, of which the rest is one on the diagonal. */
void structure_pad(double *padded, const double *matrix, size_t size);

/* Find the upper factor U of a symmetric positive definite matrix A = U' U, the sum of `base`, which may be `factor`, and
   of theta[k] * terms[k]; false if A is not positive definite. All have padded rows of `stride` numbers. Only the upper
   triangle of A is read, and behind its columns there may be right-hand sides y, which become U'^-1 y. The factor has one
   over its diagonal, by which is only divided, and -U' in the lower triangle, so that columns of U lie in one piece. */
bool structure_cholesky(double *factor, size_t size, size_t stride, const double *base, const double *terms,
                        size_t count, const double *theta);

/* Replace `right` (size) by the solution of U' y = right, then of U x = y, then of both. */
void structure_solve_lower(const double *restrict factor, size_t size, size_t stride, double *restrict right);
void structure_solve_upper(const double *restrict factor, size_t size, size_t stride, double *restrict right);

/* Replace each column of `right` (size, size) by the solution of U' y = column. */
void structure_solve_lower_columns(const double *restrict factor, size_t size, size_t stride, double *restrict right);

/* The `count` lowest eigenvalues of a symmetric matrix, ascending, and their unit vectors as rows. Few of a positive
   definite one are found several times faster than all, where they lie apart and the least of its
   diagonal are near them. `values` has room for `size`, `vectors` for (size, size), `work` for
   STRUCTURE_EIGEN_WORK(size) doubles. False if the iteration does not end, which finite numbers do not cause. */
#define STRUCTURE_EIGEN_WORK(size) (43 * (size) + 12 + structure_padded(size) * structure_padded(size))
bool structure_symmetric_eigen(const double *restrict matrix, size_t size, size_t count, double *restrict values,
                          double *restrict vectors, double *restrict work);

#if defined(__GNUC__) && !defined(_WIN32)
#pragma GCC visibility pop
#endif

#endif
