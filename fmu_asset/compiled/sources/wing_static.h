/* The steady turn: static response to lift and tip force, with its certified error bound.

   Kapteyn et al. 2021, eqs. (13), (15); the bound is that of fe/runtime/reduced.py. The response is linear in the loads,
   so that the solutions under one unit of each load are kept as long as the stiffness stays. What is kept never
   changes a result: it is a function of the stiffness alone. */
#ifndef WING_STATIC_H
#define WING_STATIC_H

#include "wing_model.h"

#if defined(__GNUC__) && !defined(_WIN32)
#pragma GCC visibility push(hidden)
#endif

/* Response to one unit of one load; computed when it is first needed. */
typedef struct {
    bool solved;
    bool bounded;
    double *coordinates; /* (N) */
    double *output;      /* (G + 1) */
    double *residual;    /* (R) */
    double *correction;  /* (G + 1), the residual applied to the approximate dual solutions */
} wing_unit_response;

typedef struct {
    const wing_model *model;
    bool factorised;
    bool dual_known;
    double health[WING_MOST_REGIONS + 1]; /* e and the losses of the factor */
    double theta[WING_MOST_TERMS];    /* e, 1 - z1, ..., 1 */
    /* Skin and everything else together, since e hardly ever changes: e times the first term plus the last. */
    bool lasting_known;
    double lasting_skin;              /* e of these */
    double *lasting_stiffness;        /* (N, N) */
    double *lasting_residual;         /* (N, R) */
    double *factor;                   /* (N, N) */
    double *dual_norm;                /* (G + 1) */
    wing_unit_response unit[WING_LOADS];
    double *work;                     /* the longest of N, R, G + 1, times K + 1 */
} wing_static;

void wing_static_lay_out(wing_static *wing, const wing_model *model, wing_arena *arena);

/* Take e and the losses; does nothing if they are those of the last call. */
bool wing_static_prepare(wing_static *wing, const double *health, wing_problem *problem);

/* Return the response to one unit of a load. */
const wing_unit_response *wing_static_unit(wing_static *wing, size_t load);

/* Displacement of the point where the tip force acts under one unit of a load [m]. */
double wing_static_load_point(wing_static *wing, size_t load);

/* Write strains and tip displacement (G + 1) under load factor [1] and tip force [N]. */
void wing_static_response(wing_static *wing, const double load[WING_LOADS], double *output);

/* Return the certified bound of the error of any strain under these loads. */
double wing_static_error_bound(wing_static *wing, const double load[WING_LOADS]);

#if defined(__GNUC__) && !defined(_WIN32)
#pragma GCC visibility pop
#endif

#endif
