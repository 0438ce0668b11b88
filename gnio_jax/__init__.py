"""gnio-jax: Gated Neural Inertial Odometry in JAX. See README.md."""
