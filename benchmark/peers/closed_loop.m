% SPDX-License-Identifier: Apache-2.0
% The recommended configuration on Section IV's arm. Usage: octave closed_loop.m DURATION
1;
function [M, C, G] = dynamics(P, r, q, dq)
  coupling = P(3) * cos(q(2));
  c = P(3) * sin(q(2));
  M = [P(1) + P(2) + 2 * coupling, P(2) + coupling; P(2) + coupling, P(2)];
  C = [-c * dq(2), -c * (dq(1) + dq(2)); c * dq(1), 0];
  outer = P(3) * r * cos(q(1) + q(2));
  G = [P(1) * r * cos(q(1)) + outer; outer];
end
function H = regressor(r, q, dq, v, a)
  c2 = cos(q(2)); s2 = sin(q(2)); c12 = cos(q(1) + q(2));
  H = [a(1) + r * cos(q(1)), a(1) + a(2), ...
       c2 * (2 * a(1) + a(2)) - s2 * (dq(2) * v(1) + (dq(1) + dq(2)) * v(2)) + r * c12;
       0, a(1) + a(2), c2 * a(1) + s2 * dq(1) * v(1) + r * c12];
end
function [Yp, Yr] = momentum(r, q, dq)
  c2 = cos(q(2)); s2 = sin(q(2)); c12 = cos(q(1) + q(2)); both = dq(1) + dq(2);
  Yp = [dq(1), both, c2 * (dq(1) + both); 0, both, c2 * dq(1)];
  Yr = [r * cos(q(1)), 0, r * c12, 1, 0; 0, 0, s2 * dq(1) * both + r * c12, 0, 1];
end
function dx = motion(P, r, t, x, tau)
  [M, C, G] = dynamics(P, r, x(1:2), x(3:4));
  dist = 0.1 + 0.1 * sin(t) * [1; 1];
  dx = [x(3:4); M \ (tau - dist - C * x(3:4) - G)];
end
function x = dp5(P, r, t, x, tau, h)
  k1 = motion(P, r, t, x, tau);
  k2 = motion(P, r, t + h / 5, x + h * k1 / 5, tau);
  k3 = motion(P, r, t + 3 * h / 10, x + h * (3 / 40 * k1 + 9 / 40 * k2), tau);
  k4 = motion(P, r, t + 4 * h / 5, x + h * (44 / 45 * k1 - 56 / 15 * k2 + 32 / 9 * k3), tau);
  k5 = motion(P, r, t + 8 * h / 9, x + h * (19372 / 6561 * k1 - 25360 / 2187 * k2 ...
       + 64448 / 6561 * k3 - 212 / 729 * k4), tau);
  k6 = motion(P, r, t + h, x + h * (9017 / 3168 * k1 - 355 / 33 * k2 + 46732 / 5247 * k3 ...
       + 49 / 176 * k4 - 5103 / 18656 * k5), tau);
  x = x + h * (35 / 384 * k1 + 500 / 1113 * k3 + 125 / 192 * k4 - 2187 / 6784 * k5 + 11 / 84 * k6);
end
duration = str2double(argv(){end});
T = 1e-3; r = 9.8; P = [1; 0.32; 0.4]; kc = 0.002; w = 1000; Slim = 2e4; K = 150; mu = 20;
lambda = 0.002; Kp = [60; 20]; gamma = 100; limit = 20; Gamma = [0.5; 0.5; 0.5; 1; 1];
kappa = 100; rho = 1e-5; sigma = 0.003; N = 6283; start = 2 * pi + 0.5; pole = 10; interval = 10;
slope = @(x) w * (1 + 2 * pi * (x / kc) ^ 2 * tan(pi / 2 * (x / kc) ^ 2)) ...
        / cos(pi / 2 * (x / kc) ^ 2) ^ 2 - Slim;
knee = fzero(slope, [0, 0.999 * kc]);
share = 1 - exp(-T / lambda); gain = 1 - exp(-pole * T);
x = [2.293; 1.696; 0; 0]; P0 = [0.5; 0.16; 0.2]; theta = [P0; 0; 0]; d3 = [0; 0]; tau = [0; 0];
pole1 = zeros(2, 6); pole2 = zeros(2, 6); ring = zeros(2, 6, N); total = zeros(6);
latched = false; samples = round(duration / T);
for k = 0:samples - 1
  t = k * T; q = x(1:2); dq = x(3:4);
  qr = [1.9935; 1.3961] + 0.3 * cos(t); dqr = -0.3 * sin(t) * [1; 1]; ddqr = -0.3 * cos(t) * [1; 1];
  xi1 = q - qr; ratio = xi1 / kc; s = pi * ratio .^ 2; part = sin(s) ./ s; part(s == 0) = 1;
  beta2 = dqr - (abs(ratio) < 1) .* (K / 2 * xi1 .* part) - mu * xi1;
  if k == 0, alpha2 = beta2; end
  dalpha2 = share * (beta2 - alpha2) / T; xi2 = dq - alpha2;
  [Yp, Yr] = momentum(r, q, dq);
  if k > 0
    X = (Yr + Yr0) / 2; X(:, 1:3) = X(:, 1:3) + (Yp - Yp0) / T;
    pole1 = pole1 + gain * ([X, tau] - pole1); pole2 = pole2 + gain * (pole1 - pole2);
    slot = mod(k - 1, N) + 1; old = ring(:, :, slot);
    total = total + pole2' * pole2 - old' * old; ring(:, :, slot) = pole2;
    if mod(k, interval) == 0 && t >= start
      mean_ = total / min(k, N);
      if min(eig(mean_(1:5, 1:5))) >= sigma
        Phi = mean_(1:5, 1:5); b = mean_(1:5, 6); latched = true;
      end
    end
  end
  Yp0 = Yp; Yr0 = Yr;
  H = regressor(r, q, dq, alpha2, dalpha2); Hr = regressor(r, qr, dqr, dqr, ddqr);
  edge = min(abs(xi1), knee);
  barrier = sign(xi1) .* (w * edge ./ cos(pi / 2 * (edge / kc) .^ 2) .^ 2 + Slim * (abs(xi1) - edge));
  demand = H * P0 + Hr * (theta(1:3) - P0) + d3 - Kp .* xi2 - barrier;
  tau = max(-limit, min(limit, demand));
  rate = zeros(5, 1);
  if latched, rate = kappa * ((Phi + rho * eye(5)) \ (b - Phi * theta)); end
  if all(tau == demand)
    rate(1:3) = rate(1:3) - Hr' * xi2; d3 = d3 - T * gamma * xi2;
  end
  theta = theta + T * Gamma .* rate;
  alpha2 = alpha2 + share * (beta2 - alpha2);
  x = dp5(P, r, t, x, tau, T);
end
printf('xi1 %.3e %.3e, parameter error %.2e\n', xi1, norm(theta(1:3) - P) / norm(P));
printf('%d\n', samples);
