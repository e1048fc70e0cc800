import numpy as np
import pytest
import torch

from lerobot_openspm.configuration_openspm import OpenSPMConfig
from lerobot_openspm.flow.condition import CONDITION_DIM
from lerobot_openspm.flow.network import VelocityField


def field(condition_dim=6, chunk_size=5, action_dim=7, width=16, seed=0):
    torch.manual_seed(seed)
    return VelocityField(condition_dim, chunk_size, action_dim, width)


@pytest.mark.parametrize("conditioning", CONDITION_DIM)
def test_the_default_network_has_the_papers_size(conditioning):
    config = OpenSPMConfig(push_to_hub=False)
    network = VelocityField(CONDITION_DIM[conditioning], config.chunk_size, 7)
    n_parameters = sum(p.numel() for p in network.parameters())
    assert 0.9 * 240_000 <= n_parameters <= 1.1 * 240_000


def test_shapes():
    network = field()
    condition, noise = torch.randn(3, 6), torch.randn(3, 5, 7)
    assert network(noise, torch.rand(3), network.encoder(condition)).shape == (3, 5, 7)
    assert network.loss(condition, noise, torch.randn(3, 5, 7), torch.rand(3)).shape == (3,)
    assert network.sample(condition, noise, 4).shape == (3, 5, 7)


@pytest.mark.parametrize("n_steps", [1, 8])
def test_the_condition_is_encoded_once_a_chunk(n_steps):
    network, calls = field(), {"encoder": 0, "decoder": 0}

    def count(name):
        return lambda *_: calls.update({name: calls[name] + 1})

    network.encoder.register_forward_hook(count("encoder"))
    network.decoder.register_forward_hook(count("decoder"))
    network.sample(torch.randn(2, 6), torch.randn(2, 5, 7), n_steps)
    assert calls == {"encoder": 1, "decoder": n_steps}


def test_samples_do_not_depend_on_the_batch_they_are_in():
    network = field()
    condition, noise = torch.randn(4, 6), torch.randn(4, 5, 7)
    together = network.sample(condition, noise, 4)
    for i in range(4):
        alone = network.sample(condition[i : i + 1], noise[i : i + 1], 4)
        torch.testing.assert_close(together[i : i + 1], alone, atol=1e-5, rtol=1e-4)


def test_the_loss_is_the_papers_formula(monkeypatch):
    """Velocity 2 a_xi + xi, by hand: two steps of one number each."""
    network = field(condition_dim=1, chunk_size=2, action_dim=1)
    network.action_scale.fill_(2.0)
    monkeypatch.setattr(network, "forward", lambda actions, time, latent: 2 * actions + time[:, None, None])
    actions, noise = torch.tensor([[[4.0], [8.0]]]), torch.tensor([[[1.0], [-1.0]]])
    loss = network.loss(torch.zeros(1, 1), actions, noise, torch.tensor([0.25]))
    # data = 2, 4; a_xi = 0.75 * noise + 0.25 * data = 1.25, 0.25; v = 2.75, 0.75; data - noise = 1, 5
    assert loss.item() == pytest.approx(((2.75 - 1) ** 2 + (0.75 - 5) ** 2) / 2)


@pytest.mark.parametrize("n_steps", [1, 3, 8])
def test_a_constant_velocity_is_integrated_exactly_from_noise_to_data(monkeypatch, n_steps):
    network = field()
    network.action_scale.copy_(torch.arange(1.0, 8.0))
    velocity = torch.randn(2, 5, 7)
    monkeypatch.setattr(network, "forward", lambda actions, time, latent: velocity)
    noise = torch.randn(2, 5, 7)
    sampled = network.sample(torch.zeros(2, 6), noise, n_steps)
    torch.testing.assert_close(sampled, (noise + velocity) * torch.arange(1.0, 8.0))


def test_the_field_is_asked_at_growing_times_from_zero(monkeypatch):
    network, times = field(), []

    def forward(actions, time, latent):
        times.append(time.tolist())
        return torch.zeros_like(actions)

    monkeypatch.setattr(network, "forward", forward)
    network.sample(torch.zeros(1, 6), torch.zeros(1, 5, 7), 4)
    np.testing.assert_allclose(times, [[0.0], [0.25], [0.5], [0.75]], atol=1e-6)


def test_the_steps_of_a_chunk_are_told_apart():
    network = field()
    out = network(torch.zeros(1, 5, 7), torch.zeros(1), network.encoder(torch.zeros(1, 6)))
    for i in range(4):
        assert not torch.allclose(out[0, i], out[0, i + 1])


@pytest.fixture
def one_thread():
    """So small a network is slower on several threads, much slower where tests run side by side."""
    before = torch.get_num_threads()
    torch.set_num_threads(1)
    yield
    torch.set_num_threads(before)


@pytest.mark.usefixtures("one_thread")
def test_two_targets_are_learned_from_their_condition():
    torch.manual_seed(1)
    network = field(condition_dim=1, chunk_size=2, action_dim=2, width=48, seed=1)
    network.action_scale.fill_(0.5)
    goals = torch.tensor([[[0.4, -0.2], [0.1, 0.3]], [[-0.5, 0.2], [0.6, 0.0]]])
    optimizer = torch.optim.Adam(network.parameters(), 5e-3)
    losses = []
    for _ in range(300):
        which = torch.randint(2, (128,))
        loss = network.loss(
            which[:, None].float(), goals[which], torch.randn(128, 2, 2), torch.rand(128)
        ).mean()
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
        losses.append(loss.item())
    assert np.mean(losses[-20:]) < 0.2 * np.mean(losses[:5])
    which = torch.arange(2).repeat(16)
    with torch.no_grad():
        sampled = network.sample(which[:, None].float(), torch.randn(32, 2, 2), 8)
    error = (sampled - goals[which]).abs()
    assert error.mean() < 0.05
