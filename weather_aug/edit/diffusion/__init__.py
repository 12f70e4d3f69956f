"""The paper's editor: one frozen one-step diffusion model, one low-rank set for each weather."""
