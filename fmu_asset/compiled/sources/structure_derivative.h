/* Derivatives of outputs with respect to inputs and parameters at the last accepted inputs: exact, since stiffness,
   mass and loads are sums of a few matrices times what can be chosen.

   At equilibrium they hold for strains and displacements with respect to all that can be chosen; in motion, where
   displacement and velocity of the modes stay, with respect to the controls of the loads; for frequencies and
   damping ratios (which must be simple) always, and with respect to the damping as well. Others are refused. */
#ifndef STRUCTURE_DERIVATIVE_H
#define STRUCTURE_DERIVATIVE_H

#include "structure_instance.h"

#if defined(__GNUC__) && !defined(_WIN32)
#pragma GCC visibility push(hidden)
#endif

/* Value references of what is derived, and of what with respect to. */
typedef struct {
    const unsigned int *unknowns;
    size_t unknown_count;
    const unsigned int *knowns;
    size_t known_count;
} structure_pairs;

/* sensitivity = J seed, with one number of the seed for each value of the knowns and one of the sensitivity for each
   of the unknowns; adjoint: sensitivity = J' seed, the other way round. */
structure_result structure_directional_derivative(structure_instance *instance, const structure_pairs *pairs,
                                                  const double *seed, size_t seed_count, double *sensitivity,
                                                  size_t sensitivity_count);
structure_result structure_adjoint_derivative(structure_instance *instance, const structure_pairs *pairs,
                                              const double *seed, size_t seed_count, double *sensitivity,
                                              size_t sensitivity_count);

#if defined(__GNUC__) && !defined(_WIN32)
#pragma GCC visibility pop
#endif

#endif
