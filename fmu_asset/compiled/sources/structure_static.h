/* Equilibrium: static response to the loads, with its certified error bounds.

   Kapteyn et al. 2021, eqs. (13), (15); the bounds are those of fe/runtime/reduced_arrays.py. The response is linear in the loads,
   so that the solutions under one unit of each load are kept as long as the stiffness stays. What is kept never
   changes a result: it is a function of the stiffness alone. */
#ifndef STRUCTURE_STATIC_H
#define STRUCTURE_STATIC_H

#include "structure_model.h"

#if defined(__GNUC__) && !defined(_WIN32)
#pragma GCC visibility push(hidden)
#endif

typedef struct {
    const structure_model *model;
    bool factorised;
    bool dual_known;
    double *health;                   /* parameters and losses of the factor */
    double *theta;                    /* (T) coefficients of the stiffness terms */
    double *theta_damaged;            /* those that losses change, in the order of the model */
    double *theta_change;             /* (T - 1) of all but the last from the reference, in the order of the model */
    /* What losses do not change, since parameters hardly ever change. */
    bool lasting_known;
    double *lasting_parameters;       /* of these sums */
    double *lasting_stiffness;        /* (N, N) */
    double *lasting_residual;         /* (N, R) */
    size_t residual_size;             /* how many directions of residuals may not be zero */
    double *factor;                   /* (N, N) */
    double *dual_norm;                /* (O) */
    double *dual_weights;             /* (M, O) coefficients of the dual functions in the approximate solutions */
    double *dual_products;            /* (M, O) what the functions give, applied to a residual */
    double *dual_work;                /* a dual problem, or all dual residuals */
    /* Response to one unit of each load; computed when it is first needed. */
    bool *solved, *bounded;           /* (L) */
    double *coordinates;              /* (L, N) */
    double *output;                   /* (L, O) */
    double *residual;                 /* (L, R) */
    double *correction;               /* (L, O), the residual applied to the approximate dual solutions */
    /* The same under all loads together: (N), (R), (O). */
    double *whole_coordinates, *whole_residual, *whole_correction;
    double *work;                     /* the longest of N, R, O, times the number of damaged terms and one; or T */
} structure_static;

/* Bounds of the error of any strain, and of any displacement. */
typedef struct {
    double strain;
    double displacement;
} structure_bounds;

void structure_static_lay_out(structure_static *steady, const structure_model *model, structure_arena *arena);

/* Take parameters and losses, the first of what can be chosen; does nothing if they are those of the last call. */
bool structure_static_prepare(structure_static *steady, const double *chosen, structure_problem *problem);

/* Find the response to one unit of a load: `coordinates` and `output` of that load. */
void structure_static_solve(structure_static *steady, size_t load);

/* Displacement along the load of index `point` at its point under one unit of a load [m]. */
double structure_static_load_point(structure_static *steady, size_t point, size_t load);

/* Write strains and displacements (O) under loads (L). */
void structure_static_response(structure_static *steady, const double *load, double *output);

/* Write the derivatives of strains and displacements (O) under loads (L), and of the displacement along the load of
   index `point`, with respect to one of what can be chosen. */
void structure_static_derivative(structure_static *steady, const double *chosen, const double *load, size_t which,
                                 size_t point, double *output, double *load_point);

/* Return the certified bounds under these loads. */
structure_bounds structure_static_error_bounds(structure_static *steady, const double *load);

#if defined(__GNUC__) && !defined(_WIN32)
#pragma GCC visibility pop
#endif

#endif
