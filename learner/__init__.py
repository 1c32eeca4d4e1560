"""The learner: burn-in, the joint update of model, Q, policy and temperature, weights out."""
