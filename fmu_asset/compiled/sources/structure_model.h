/* The reduced model: what fe/runtime/reduced_arrays.py describes, with a few arrays laid out anew for speed.

   All that can be chosen stands in one vector, in this order: parameters (factors on the stiffness), losses of the
   damage regions, masses [kg], controls of the loads. A term of the stiffness is times one parameter or none and
   times (1 - loss) of one region or none; a load is times one control or none and times one mass or none. Every
   size stands in the data file: a wing and a structure from a mesh are the same to these sources. */
#ifndef STRUCTURE_MODEL_H
#define STRUCTURE_MODEL_H

#include "structure_data.h"

#if defined(__GNUC__) && !defined(_WIN32)
#pragma GCC visibility push(hidden)
#endif

#define STRUCTURE_MOST_REGIONS 8
#define STRUCTURE_TILE 16 /* directions of residuals that are found at once */

/* Two positions in the vector of what can be chosen, counted from one; zero for none. */
typedef struct {
    size_t first;
    size_t second;
} structure_factors;

typedef struct {
    size_t static_size;   /* N, static basis vectors */
    size_t modal_size;    /* Nm, modal basis vectors */
    size_t mode_count;    /* M, modes that are kept */
    size_t gauges;        /* G, strains, the first outputs */
    size_t output_count;  /* O: strains, then displacements */
    size_t modal_outputs; /* O and the accelerations */
    size_t residual_size; /* R, basis of the residuals */
    size_t health_residual; /* the first of them, in which residuals are where only losses differ from the reference */
    size_t terms;         /* T, terms of the stiffness, of which the last is times one */
    size_t loads;         /* L */
    size_t masses;        /* P, masses that can be chosen; the terms of the mass are one more */
    size_t parameters;
    size_t regions;       /* K, damage regions */
    size_t controls;
    size_t chosen;        /* V, all that can be chosen */
    size_t health;        /* parameters and losses, the first of what can be chosen: the stiffness */
    size_t key;           /* these and the masses: the modes */
    size_t lasting;                 /* terms whose coefficient no loss changes; the first of `order` */
    size_t *order;                  /* (T) terms in the order of `stiffness_terms`: the last one, others, damage */
    structure_factors *stiffness_factors; /* (T) parameter and loss of each term */
    structure_factors *load_factors;      /* (L) control and mass of each load */
    const double *static_load;      /* (L, N) */
    const double *bound_reference;  /* (T - 1) */
    const double *dual_split;       /* (K) where the second of two anchors along a loss takes over, A = 2^K; or NULL */
    size_t functions;               /* M, dual functions of an output that are combined */
    size_t dual_rows, dual_columns; /* F and 1 + T M, of a factor of a dual residual */
    const double *dual_stiffness;   /* (A, O, T, M, M) */
    const double *dual_output;      /* (A, O, M) */
    const double *modal_stiffness;  /* (T, Nm, Nm) */
    const double *modal_mass;       /* (1 + P, Nm, Nm) */
    const double *modal_load;       /* (L, Nm) */
    double residual_allowance;
    double rounding_allowance;
    /* laid out anew: columns one after another */
    size_t padded_size, stride; /* of the static basis, and with the loads behind it */
    double *stiffness_terms;    /* (T, padded size, stride) in the order of `order`; the first with the loads */
    double *output_columns;     /* (N, O) */
    double *modal_output;       /* (Nm, modal_outputs) */
    double *cross_mass;         /* (1 + P, N, Nm) */
    double *load_residual;      /* (L, R) */
    double *stiffness_residual; /* (T - 1, N, R) in the order of `order`, without the first of it */
    size_t *residual_begins;    /* (damaged terms, tiles of R) columns before which a tile has only zeros */
    double *correction_columns; /* (A, R, M O) */
    double *dual_factor;        /* (A, dual columns, dual rows, O) */
    structure_data data;        /* owns the arrays */
    double *memory;             /* owns what was laid out anew */
    size_t *places;             /* owns `order` */
    structure_factors *factors; /* owns both tables of factors */
} structure_model;

/* Read and check a model. On success the caller frees it with `structure_model_free`. */
bool structure_model_read(structure_model *model, const char *path, structure_problem *problem);

void structure_model_free(structure_model *model);

/* Write the coefficients of the stiffness terms (T), of the mass terms (1 + P) and of the loads (L). */
void structure_stiffness_coefficients(const structure_model *model, const double *chosen, double *theta);
void structure_mass_coefficients(const structure_model *model, const double *chosen, double *theta);
void structure_load_coefficients(const structure_model *model, const double *chosen, double *load);

/* Derivatives of the coefficient of one term or load with respect to one of what can be chosen. */
double structure_stiffness_derivative(const structure_model *model, size_t term, const double *chosen, size_t which);
double structure_load_derivative(const structure_model *model, size_t load, const double *chosen, size_t which);

/* Whether one of what can be chosen is a control of the loads. */
bool structure_is_control(const structure_model *model, size_t which);

#if defined(__GNUC__) && !defined(_WIN32)
#pragma GCC visibility pop
#endif

#endif
