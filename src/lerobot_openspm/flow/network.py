"""The velocity field: condition encoded once, one decoder shared by all steps of the chunk."""

from __future__ import annotations

import math
from collections.abc import Callable

import torch
from lerobot.policies.common.flow_matching import euler_integrate
from torch import Tensor, nn

TIME_FEATURES = 16
STEP_FEATURES = 8
# Gives the 240 K parameters of the paper's model.
WIDTH = 268


class VelocityField(nn.Module):
    """``v_theta(a_xi, xi, c)`` of the paper, about 240 K parameters at the default width.

    Args:
        condition_dim: Length of the condition vector.
        chunk_size: Actions per chunk, the paper's H.
        action_dim: Numbers per action.
        width: Width of the hidden layers and of the latent condition.
    """

    action_scale: Tensor

    def __init__(self, condition_dim: int, chunk_size: int, action_dim: int, width: int = WIDTH):
        super().__init__()
        self.chunk_size, self.action_dim = chunk_size, action_dim
        self.encoder = nn.Sequential(
            nn.Linear(condition_dim, width), nn.SiLU(), nn.Linear(width, width), nn.SiLU()
        )  # fmt: skip
        self.step_embedding = nn.Embedding(chunk_size, STEP_FEATURES)
        decoder_dim = width + chunk_size * action_dim + TIME_FEATURES + STEP_FEATURES
        self.decoder = nn.Sequential(
            nn.Linear(decoder_dim, width), nn.SiLU(), nn.Linear(width, width), nn.SiLU(),
            nn.Linear(width, action_dim),
        )  # fmt: skip
        # Actions are learned in units of their spread over the demonstrations.
        self.register_buffer("action_scale", torch.ones(action_dim))

    def forward(self, actions: Tensor, time: Tensor, latent: Tensor) -> Tensor:
        """Velocity of noisy chunks, both ``(b, H, action_dim)``, at flow times ``(b,)`` in [0, 1].

        `latent` is ``encoder(condition)``, ``(b, width)``, computed once per chunk for all Euler steps.
        """
        b, h = actions.shape[0], self.chunk_size
        context = torch.cat([latent, actions.flatten(1), _time_features(time)], dim=-1)
        steps = self.step_embedding.weight.expand(b, h, -1)
        return self.decoder(torch.cat([context[:, None].expand(b, h, -1), steps], dim=-1))

    def loss(self, condition: Tensor, actions: Tensor, noise: Tensor, time: Tensor) -> Tensor:
        """``L_FM`` per sample ``(b,)``: squared error of the velocity at ``a_xi = (1 - xi) a_0 + xi a_data``.

        Args:
            condition: ``(b, condition_dim)``.
            actions: Demonstrated chunks ``(b, H, action_dim)`` in action units.
            noise: ``a_0``, standard normal, of the same shape.
            time: ``xi`` in [0, 1], ``(b,)``.
        """
        data = actions / self.action_scale
        xi = time[:, None, None]
        velocity = self((1 - xi) * noise + xi * data, time, self.encoder(condition))
        return (velocity - (data - noise)).square().mean(dim=(1, 2))

    def sample(self, condition: Tensor, noise: Tensor, n_steps: int) -> Tensor:
        """Integrate the field from noise to chunks ``(b, H, action_dim)`` in action units, by Euler steps."""
        latent = self.encoder(condition)
        # LeRobot's integrator runs from t = 1 (noise) to t = 0 (data); the paper's xi is 1 - t.
        reversed_field: Callable[[Tensor, Tensor], Tensor] = lambda a, t: -self(a, 1 - t, latent)  # noqa: E731
        return euler_integrate(reversed_field, noise, n_steps) * self.action_scale


def _time_features(time: Tensor) -> Tensor:
    frequencies = math.pi * 2.0 ** torch.arange(TIME_FEATURES // 2, device=time.device) / 4
    angles = time[:, None] * frequencies
    return torch.cat([angles.sin(), angles.cos()], dim=-1)
