/* FMI 2.0 co-simulation: x' = A x + B u, y = C x + D u with two states, inputs and outputs.
   The inputs are held over a step and the states then follow exactly, so that whatever a coupled system gets
   wrong is the coupling's. */
#include <math.h>
#include "model.h"
enum { X, U = 2, Y = 4, A = 6, B = 10, C = 14, D = 18, INITIAL = 22, SIZE = 4 };

static void multiply(double to[SIZE][SIZE], double a[SIZE][SIZE], double b[SIZE][SIZE]) {
    for (int i = 0; i < SIZE; i++)
        for (int j = 0; j < SIZE; j++) {
            to[i][j] = 0.0;
            for (int k = 0; k < SIZE; k++) to[i][j] += a[i][k] * b[k][j];
        }
}

/* The exponential of a matrix: its series at a quarter of it, squared twice. */
static void exponential(double matrix[SIZE][SIZE], double found[SIZE][SIZE]) {
    double term[SIZE][SIZE], next[SIZE][SIZE];
    for (int k = 0; k < SIZE * SIZE; k++) {
        matrix[0][k] /= 4.0;
        found[0][k] = term[0][k] = k % (SIZE + 1) == 0;
    }
    for (int order = 1; order < 24; order++) {
        multiply(next, term, matrix);
        for (int k = 0; k < SIZE * SIZE; k++) found[0][k] += term[0][k] = next[0][k] / order;
    }
    for (int k = 0; k < 2; k++) {
        multiply(next, found, found);
        memcpy(found, next, sizeof next);
    }
}

static void give(Model *m) {
    for (int i = 0; i < 2; i++) {
        m->r[Y + i] = 0.0;
        for (int j = 0; j < 2; j++) m->r[Y + i] += m->r[C + 2 * i + j] * m->r[X + j] + m->r[D + 2 * i + j] * m->r[U + j];
    }
}
int model_initialise(Model *m) {
    memcpy(m->r + X, m->r + INITIAL, 2 * sizeof(double));
    give(m);
    return OK;
}
int model_step(Model *m, double time, double size) {
    double block[SIZE][SIZE] = {0}, whole[SIZE][SIZE], before[SIZE];
    for (int i = 0; i < 2; i++)
        for (int j = 0; j < 2; j++) {
            block[i][j] = m->r[A + 2 * i + j] * size;
            block[i][2 + j] = m->r[B + 2 * i + j] * size;
        }
    exponential(block, whole);
    memcpy(before, m->r + X, sizeof before);
    for (int i = 0; i < 2; i++) {
        m->r[X + i] = 0.0;
        for (int j = 0; j < SIZE; j++) m->r[X + i] += whole[i][j] * before[j];
    }
    give(m);
    return OK;
}
