/* The reduced model: what fe/runtime/reduced_arrays.py describes, with a few arrays laid out anew for speed. */
#ifndef WING_MODEL_H
#define WING_MODEL_H

#include "wing_data.h"

#if defined(__GNUC__) && !defined(_WIN32)
#pragma GCC visibility push(hidden)
#endif

/* Room for damage regions and for the terms of the stiffness: skin (times e), the damage regions (each times
   1 - z of its own), everything else. How many there are stands in the data file. */
#define WING_MOST_REGIONS 8
#define WING_MOST_TERMS (WING_MOST_REGIONS + 2)
/* Terms of the mass: structure, servos, pitot. */
#define WING_MASS_TERMS 3
/* Loads: lift at load factor 1, tip force of 1 N. */
#define WING_LOADS 2

typedef struct {
    size_t static_size;   /* N, static basis vectors */
    size_t modal_size;    /* Nm, modal basis vectors */
    size_t mode_count;    /* M, modes that are kept */
    size_t output_count;  /* G + 1: gauges, then the tip displacement */
    size_t residual_size; /* R, basis of the residuals */
    size_t regions;       /* K, damage regions */
    size_t terms;         /* T = K + 2, terms of the stiffness */
    size_t anchors[WING_MOST_REGIONS]; /* approximate dual solutions along each loss, A in all */
    const double *static_stiffness; /* (T, N, N) */
    const double *static_load;      /* (2, N) */
    const double *bound_reference;  /* (K + 1) */
    const double *dual_split[WING_MOST_REGIONS]; /* (anchors less one) of each region, ascending */
    const double *dual_residual;    /* (A, G + 1, T, T) */
    const double *modal_stiffness;  /* (T, Nm, Nm) */
    const double *modal_mass;       /* (3, Nm, Nm) */
    const double *modal_load;       /* (2, Nm) */
    const double *modal_output;     /* (G + 1, Nm) */
    const double *cross_mass;       /* (3, Nm, N) */
    double residual_allowance;
    double rounding_allowance;
    /* laid out anew: columns one after another */
    double *output_columns;     /* (N, G + 1) */
    double *load_residual;      /* (2, R) */
    double *stiffness_residual; /* (T, N, R) */
    double *correction_columns; /* (A, R, G + 1) */
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
