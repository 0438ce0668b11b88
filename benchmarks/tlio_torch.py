"""TLIO's network in PyTorch, written from its description. Its gradient is timed beside ours."""

import torch
from torch import nn


class _Block(nn.Module):
    def __init__(self, channels: int, features: int, stride: int):
        super().__init__()
        self.body = nn.Sequential(
            nn.Conv1d(channels, features, 3, stride, 1, bias=False),
            nn.BatchNorm1d(features),
            nn.ReLU(),
            nn.Conv1d(features, features, 3, 1, 1, bias=False),
            nn.BatchNorm1d(features),
        )
        self.shortcut = nn.Identity()
        if stride != 1 or channels != features:
            self.shortcut = nn.Sequential(
                nn.Conv1d(channels, features, 1, stride, bias=False), nn.BatchNorm1d(features)
            )

    def forward(self, x: torch.Tensor) -> torch.Tensor:
        return torch.relu(self.body(x) + self.shortcut(x))


def _head(positions: int) -> nn.Module:
    return nn.Sequential(
        nn.Conv1d(512, 128, 1, bias=False),
        nn.BatchNorm1d(128),
        nn.Flatten(),
        nn.Linear(128 * positions, 512),
        nn.ReLU(),
        nn.Dropout(0.5),
        nn.Linear(512, 512),
        nn.ReLU(),
        nn.Dropout(0.5),
        nn.Linear(512, 3),
    )


class TlioNetwork(nn.Module):
    """From windows (b, 6, n) to displacement (b, 3) and log standard deviation (b, 3).

    5,424,646 parameters at n = 200.
    """

    def __init__(self, samples: int):
        super().__init__()
        layers: list[nn.Module] = [
            nn.Conv1d(6, 64, 7, 2, 3, bias=False),
            nn.BatchNorm1d(64),
            nn.ReLU(),
            nn.MaxPool1d(3, 2, 1),
        ]
        channels = 64
        for group in range(4):
            features = 64 * 2**group
            layers += [
                _Block(channels, features, 1 if group == 0 else 2),
                _Block(features, features, 1),
            ]
            channels = features
        self.encoder = nn.Sequential(*layers)
        self.mean, self.log_std = _head(-(-samples // 32)), _head(-(-samples // 32))

    def forward(self, x: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        features = self.encoder(x)
        return self.mean(features), self.log_std(features)
