/* The reduced model: what fe/runtime/reduced_arrays.py describes, with a few arrays laid out anew for speed. */
#ifndef WING_MODEL_H
#define WING_MODEL_H

#include "wing_data.h"

#if defined(__GNUC__) && !defined(_WIN32)
#pragma GCC visibility push(hidden)
#endif

/* Terms of the stiffness: skin (times e), first and second defect region (times 1 - z), everything else. */
#define WING_STIFFNESS_TERMS 4
/* Terms of the mass: structure, servos, pitot. */
#define WING_MASS_TERMS 3
/* Loads: lift at load factor 1, tip force of 1 N. */
#define WING_LOADS 2
#define WING_DUAL_TERMS 4

typedef struct {
    size_t static_size;   /* N, static basis vectors */
    size_t modal_size;    /* Nm, modal basis vectors */
    size_t mode_count;    /* M, modes that are kept */
    size_t output_count;  /* G + 1: gauges, then the tip displacement */
    size_t residual_size; /* R, basis of the residuals */
    size_t anchors[2];    /* A1, A2: approximate dual solutions by health */
    const double *static_stiffness; /* (4, N, N) */
    const double *static_load;      /* (2, N) */
    const double *bound_reference;  /* (3) */
    const double *dual_split[2];    /* (A1 - 1), (A2 - 1), ascending */
    const double *dual_residual;    /* (A1, A2, G + 1, 4, 4) */
    const double *modal_stiffness;  /* (4, Nm, Nm) */
    const double *modal_mass;       /* (3, Nm, Nm) */
    const double *modal_load;       /* (2, Nm) */
    const double *modal_output;     /* (G + 1, Nm) */
    const double *cross_mass;       /* (3, Nm, N) */
    double residual_allowance;
    double rounding_allowance;
    /* laid out anew: columns one after another */
    double *output_columns;     /* (N, G + 1) */
    double *load_residual;      /* (2, R) */
    double *stiffness_residual; /* (4, N, R) */
    double *correction_columns; /* (A1, A2, R, G + 1) */
    wing_data data;             /* owns the arrays */
    double *memory;             /* owns what was laid out anew */
} wing_model;

/* Read and check a model. On success the caller frees it with `wing_model_free`. */
bool wing_model_read(wing_model *model, const char *path, wing_problem *problem);

void wing_model_free(wing_model *model);

#if defined(__GNUC__) && !defined(_WIN32)
#pragma GCC visibility pop
#endif

#endif
