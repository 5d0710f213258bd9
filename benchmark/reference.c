/* SPDX-License-Identifier: Apache-2.0
 *
 * The closed loop of the recommended configuration in C, as one would write it for this arm alone:
 * two joints, three parameters and two bias columns known to the compiler, all state in one struct.
 * It is what the package's general kernels are measured against, and it must give their numbers.
 */
#include <math.h>
#include <stdlib.h>
#include <string.h>

enum { N = 2, P = 3, M = 5, W = M + 1, STAGES = 6 };

typedef struct {
    double l1, l2, m1, m2, g;                            /* arm */
    double constant[N], amplitude[N], frequency[N], phase[N]; /* tau_dist */
    double viscous[N], coulomb[N], coulomb_velocity;
    double q0[N], dq0[N];
    double offset[N], swing[N], tone;                    /* reference */
    double bound[N], weight[N], slope_limit[N], knee[N]; /* barrier */
    double K[N], mu[N], lambda;                          /* surface */
    double Kp[N], gamma[N], limit[N];
    double P0[P], Gamma[M], kappa, rho, sigma, start, pole, radius;
    double T;
    long window, interval;
} settings;

typedef struct {
    double y[2 * N];                                     /* plant: q, dq */
    double alpha2[N], torque[N], d3[N], theta[M];
    double Yp[N][P], Yr[N][M];
    double filter1[N][W], filter2[N][W];
    double S[M][W], F[M][W], Phi[M][M], b[M], L[M][M], weakest[M];
    double lambda_min;
    long samples, cursor, rows;
    int latched;
    double (*ring)[N][W];
} loop;

static double barrier(const settings *s, int i, double xi)
{
    double edge = fmin(fabs(xi), s->knee[i]);
    double ratio = edge / s->bound[i];
    double c = cos(0.5 * M_PI * ratio * ratio);
    double torque = s->weight[i] * edge / (c * c) + s->slope_limit[i] * (fabs(xi) - edge);
    return xi >= 0.0 ? torque : -torque;
}

static double sinc(double x) { return fabs(x) < 1e-4 ? 1.0 - x * x / 6.0 : sin(x) / x; }

static void factorise(double A[M][M], double shift, double L[M][M])
{
    for (int j = 0; j < M; j++) {
        double pivot = A[j][j] + shift;
        for (int k = 0; k < j; k++) pivot -= L[j][k] * L[j][k];
        L[j][j] = 1.0 / sqrt(fmax(pivot, shift));
        for (int i = j + 1; i < M; i++) {
            double value = A[i][j];
            for (int k = 0; k < j; k++) value -= L[i][k] * L[j][k];
            L[i][j] = value * L[j][j];
        }
    }
}

static void solve(double L[M][M], double x[M])
{
    for (int i = 0; i < M; i++) {
        for (int k = 0; k < i; k++) x[i] -= L[i][k] * x[k];
        x[i] *= L[i][i];
    }
    for (int i = M - 1; i >= 0; i--) {
        for (int k = i + 1; k < M; k++) x[i] -= L[k][i] * x[k];
        x[i] *= L[i][i];
    }
}

static void regressors(const settings *s, const double q[N], const double dq[N], double Yp[N][P],
                       double Yr[N][M])
{
    double r = s->g / s->l1, c2 = cos(q[1]), c12 = cos(q[0] + q[1]);
    memset(Yp, 0, sizeof(double[N][P]));
    memset(Yr, 0, sizeof(double[N][M]));
    Yp[0][0] = dq[0];
    Yp[0][1] = Yp[1][1] = dq[0] + dq[1];
    Yp[0][2] = c2 * (2.0 * dq[0] + dq[1]);
    Yp[1][2] = c2 * dq[0];
    Yr[0][0] = r * cos(q[0]);
    Yr[0][2] = r * c12;
    Yr[1][2] = sin(q[1]) * dq[0] * (dq[0] + dq[1]) + r * c12;
    Yr[0][P] = Yr[1][P + 1] = 1.0;
}

static void filter_and_push(const settings *s, loop *x, double Yp[N][P], double Yr[N][M])
{
    double gain = 1.0 - exp(-s->T * s->pole);
    double row[N][W];
    for (int i = 0; i < N; i++)
        for (int j = 0; j < W; j++) {
            double value;
            if (j == M) {
                value = x->torque[i];
            } else {
                value = 0.5 * (Yr[i][j] + x->Yr[i][j]);
                if (j < P) value += (Yp[i][j] - x->Yp[i][j]) * (1.0 / s->T);
            }
            x->filter1[i][j] += gain * (value - x->filter1[i][j]);
            x->filter2[i][j] += gain * (x->filter1[i][j] - x->filter2[i][j]);
            row[i][j] = x->filter2[i][j];
        }
    double(*old)[W] = x->ring[x->cursor];
    for (int a = 0; a < M; a++)
        for (int b = a; b < W; b++) {
            double new_term = 0.0, old_term = 0.0;
            for (int i = 0; i < N; i++) {
                new_term += row[i][a] * row[i][b];
                old_term += old[i][a] * old[i][b];
            }
            x->S[a][b] += new_term - old_term;
            x->F[a][b] += new_term;
        }
    memcpy(old, row, sizeof row);
    if (x->rows < s->window) x->rows++;
    if (++x->cursor == s->window) {
        x->cursor = 0;
        memcpy(x->S, x->F, sizeof x->S);
        memset(x->F, 0, sizeof x->F);
    }
}

static void look(const settings *s, loop *x, double t)
{
    double Phi[M][M], b[M], L[M][M] = {{0}}, quotient = 0.0;
    for (int i = 0; i < M; i++) {
        b[i] = x->S[i][M] / x->rows;
        for (int j = i; j < M; j++) Phi[i][j] = Phi[j][i] = x->S[i][j] / x->rows;
    }
    factorise(Phi, s->rho, L);
    for (int k = 0; k < 4; k++) {
        double square = 0.0;
        solve(L, x->weakest);
        for (int i = 0; i < M; i++) square += x->weakest[i] * x->weakest[i];
        double shrink = 1.0 / sqrt(square);
        for (int i = 0; i < M; i++) x->weakest[i] *= shrink;
    }
    for (int i = 0; i < M; i++) {
        double product = 0.0;
        for (int j = 0; j < M; j++) product += Phi[i][j] * x->weakest[j];
        quotient += x->weakest[i] * product;
    }
    x->lambda_min = quotient;
    if (t >= s->start && quotient >= s->sigma) {
        memcpy(x->Phi, Phi, sizeof Phi);
        memcpy(x->b, b, sizeof b);
        memcpy(x->L, L, sizeof L);
        x->latched = 1;
    }
}

static void adapt(const settings *s, loop *x, double H[N][P], const double xi2[N], int saturated)
{
    double rate[M] = {0.0}, by_tracking[M], square = 0.0, outward = 0.0, metric = 0.0;
    if (x->latched) {
        for (int i = 0; i < M; i++) {
            rate[i] = x->b[i];
            for (int j = 0; j < M; j++) rate[i] -= x->Phi[i][j] * x->theta[j];
        }
        solve(x->L, rate);
    }
    for (int j = 0; j < M; j++) {
        double tracking = 0.0;
        if (j < P && !saturated)
            for (int i = 0; i < N; i++) tracking += H[i][j] * xi2[i];
        by_tracking[j] = x->theta[j] - s->T * s->Gamma[j] * tracking;
        rate[j] = s->Gamma[j] * (s->kappa * rate[j] - tracking);
    }
    for (int j = 0; j < P; j++) {
        square += x->theta[j] * x->theta[j];
        outward += x->theta[j] * rate[j];
        metric += x->theta[j] * s->Gamma[j] * x->theta[j];
    }
    if (square >= (1.0 - 1e-12) * s->radius * s->radius && outward > 0.0 && metric > 0.0)
        for (int j = 0; j < P; j++) rate[j] -= s->Gamma[j] * x->theta[j] * outward / metric;
    for (int j = 0; j < M; j++) x->theta[j] += s->T * rate[j];
    square = 0.0;
    for (int j = 0; j < P; j++) square += x->theta[j] * x->theta[j];
    if (square > s->radius * s->radius)
        for (int j = 0; j < P; j++) x->theta[j] *= s->radius / sqrt(square);
    if (!saturated)
        for (int i = 0; i < N; i++) x->d3[i] -= s->T * s->gamma[i] * xi2[i];
    if (x->latched)
        for (int i = 0; i < N; i++)
            for (int j = 0; j < P; j++) x->d3[i] -= H[i][j] * (x->theta[j] - by_tracking[j]);
}

static void regressor(const settings *s, const double q[N], const double dq[N], const double v[N],
                      const double a[N], double H[N][P])
{
    double r = s->g / s->l1, c2 = cos(q[1]), s2 = sin(q[1]), c12 = cos(q[0] + q[1]);
    H[0][0] = a[0] + r * cos(q[0]);
    H[0][1] = H[1][1] = a[0] + a[1];
    H[0][2] = c2 * (2.0 * a[0] + a[1]) - s2 * (dq[1] * v[0] + (dq[0] + dq[1]) * v[1]) + r * c12;
    H[1][0] = 0.0;
    H[1][2] = c2 * a[0] + s2 * dq[0] * v[0] + r * c12;
}

static void control(const settings *s, loop *x, double t, double xi1[N])
{
    double qr[N], dqr[N], ddqr[N], a[N], v[N], xi2[N], beta2[N];
    double H[N][P], Hr[N][P], Yp[N][P], Yr[N][M];
    const double q[N] = {x->y[0], x->y[1]}, dq[N] = {x->y[2], x->y[3]};
    double share = 1.0 - exp(-s->T / s->lambda);
    int saturated = 0;
    for (int i = 0; i < N; i++) {
        double angle = s->tone * t, rate = s->tone * s->swing[i];
        double ratio;
        qr[i] = s->offset[i] + s->swing[i] * cos(angle);
        dqr[i] = -rate * sin(angle);
        ddqr[i] = -s->tone * rate * cos(angle);
        xi1[i] = q[i] - qr[i];
        ratio = xi1[i] / s->bound[i];
        beta2[i] = dqr[i] - s->mu[i] * xi1[i];
        if (fabs(ratio) < 1.0) beta2[i] -= 0.5 * s->K[i] * xi1[i] * sinc(M_PI * ratio * ratio);
        if (x->samples == 0) x->alpha2[i] = beta2[i];
        v[i] = x->alpha2[i];
        a[i] = share * (beta2[i] - v[i]) / s->T;
        xi2[i] = dq[i] - v[i];
    }
    regressor(s, q, dq, v, a, H);
    regressor(s, qr, dqr, dqr, ddqr, Hr);
    regressors(s, q, dq, Yp, Yr);
    if (x->samples > 0) {
        filter_and_push(s, x, Yp, Yr);
        if (x->samples % s->interval == 0) look(s, x, t);
    }
    memcpy(x->Yp, Yp, sizeof Yp);
    memcpy(x->Yr, Yr, sizeof Yr);

    for (int i = 0; i < N; i++) {
        double torque = x->d3[i] - s->Kp[i] * xi2[i] - barrier(s, i, xi1[i]);
        for (int j = 0; j < P; j++)
            torque += H[i][j] * s->P0[j] + Hr[i][j] * (x->theta[j] - s->P0[j]);
        x->torque[i] = fmin(s->limit[i], fmax(-s->limit[i], torque));
        saturated |= x->torque[i] != torque;
    }
    adapt(s, x, Hr, xi2, saturated);
    for (int i = 0; i < N; i++) x->alpha2[i] += share * (beta2[i] - x->alpha2[i]);
    x->samples++;
}

static double load(const settings *s, int i, double t, double dq)
{
    double torque = s->constant[i] + s->amplitude[i] * sin(s->frequency[i] * t + s->phase[i]);
    torque += s->viscous[i] * dq;
    if (s->coulomb[i] != 0.0) torque += s->coulomb[i] * tanh(dq / s->coulomb_velocity);
    return torque;
}

static void motion(const settings *s, double t, const double y[2 * N], const double torque[N],
                   double dy[2 * N])
{
    double outer = s->m2 * s->l2 * s->l2, couple = s->m2 * s->l1 * s->l2, c2 = cos(y[1]);
    double m11 = (s->m1 + s->m2) * s->l1 * s->l1 + outer + 2.0 * couple * c2;
    double m12 = outer + couple * c2, c = couple * sin(y[1]);
    double g2 = s->m2 * s->g * s->l2 * cos(y[0] + y[1]);
    double g1 = (s->m1 + s->m2) * s->g * s->l1 * cos(y[0]) + g2;
    double f[N], det = m11 * outer - m12 * m12;
    for (int i = 0; i < N; i++)
        f[i] = torque[i] - load(s, i, t, y[N + i]);
    f[0] += c * y[3] * (2.0 * y[2] + y[3]) - g1;
    f[1] -= c * y[2] * y[2] + g2;
    dy[0] = y[2];
    dy[1] = y[3];
    dy[2] = (outer * f[0] - m12 * f[1]) / det;
    dy[3] = (m11 * f[1] - m12 * f[0]) / det;
}

static void integrate(const settings *s, loop *x, double t)
{
    static const double C[STAGES] = {0.0, 1.0 / 5, 3.0 / 10, 4.0 / 5, 8.0 / 9, 1.0};
    static const double A[STAGES][STAGES - 1] = {
        {0.0},
        {1.0 / 5},
        {3.0 / 40, 9.0 / 40},
        {44.0 / 45, -56.0 / 15, 32.0 / 9},
        {19372.0 / 6561, -25360.0 / 2187, 64448.0 / 6561, -212.0 / 729},
        {9017.0 / 3168, -355.0 / 33, 46732.0 / 5247, 49.0 / 176, -5103.0 / 18656}};
    static const double B[STAGES] = {35.0 / 384,       0.0,           500.0 / 1113,
                                     125.0 / 192, -2187.0 / 6784, 11.0 / 84};
    double *y = x->y, k[STAGES][2 * N], z[2 * N];
    for (int stage = 0; stage < STAGES; stage++) {
        for (int i = 0; i < 2 * N; i++) {
            double slope = 0.0;
            for (int j = 0; j < stage; j++) slope += A[stage][j] * k[j][i];
            z[i] = y[i] + s->T * slope;
        }
        motion(s, t + C[stage] * s->T, z, x->torque, k[stage]);
    }
    for (int i = 0; i < 2 * N; i++) {
        double slope = 0.0;
        for (int j = 0; j < STAGES; j++) slope += B[j] * k[j][i];
        y[i] += s->T * slope;
    }
}

/* Run `samples` samples. Each leaves [xi1, torque, theta] in its row of `out` (samples x 9). Returns
 * 0, or 1 where there is no memory. */
int run(const settings *s, long samples, double *out)
{
    double xi1[N];
    loop *x = calloc(1, sizeof *x);
    if (x) x->ring = calloc((size_t)s->window, sizeof *x->ring);
    if (!x || !x->ring) {
        free(x);
        return 1;
    }
    memcpy(x->y, s->q0, sizeof s->q0);
    memcpy(x->y + N, s->dq0, sizeof s->dq0);
    memcpy(x->theta, s->P0, sizeof s->P0);
    for (int i = 0; i < M; i++) x->weakest[i] = 1.0 / sqrt(M);
    for (long k = 0; k < samples; k++) {
        double t = (double)k * (s->T * 1e9) * 1e-9;
        double *row = out + k * (2 * N + M);
        control(s, x, t, xi1);
        memcpy(row, xi1, sizeof xi1);
        memcpy(row + N, x->torque, sizeof x->torque);
        memcpy(row + 2 * N, x->theta, sizeof x->theta);
        integrate(s, x, t);
    }
    free(x->ring);
    free(x);
    return 0;
}
