/* The physics of splatjax.monte_carlo for one slab, photon by photon, in plain C on one thread.
   walk PHOTONS SIGMA_A SIGMA_S G ETA THICKNESS: prints reflectance, transmittance, absorbed, flights and seconds as JSON. */
#include <math.h>
#include <stdint.h>
#include <stdio.h>
#include <stdlib.h>
#include <time.h>

#define RINGS 128

static uint64_t state[4];

static uint64_t rotated(uint64_t x, int k) { return (x << k) | (x >> (64 - k)); }

/* xoshiro256+ (Blackman and Vigna 2018), in (0, 1). */
static double uniform(void) {
    uint64_t result = state[0] + state[3], shifted = state[1] << 17;
    state[2] ^= state[0];
    state[3] ^= state[1];
    state[1] ^= state[2];
    state[0] ^= state[3];
    state[2] ^= shifted;
    state[3] = rotated(state[3], 45);
    return ((double)(result >> 11) + 0.5) * 0x1.0p-53;
}

/* SplitMix64, to fill the state. */
static void seed(uint64_t x) {
    for (int i = 0; i < 4; i++) {
        uint64_t z = (x += 0x9E3779B97F4A7C15u);
        z = (z ^ (z >> 30)) * 0xBF58476D1CE4E5B9u;
        z = (z ^ (z >> 27)) * 0x94D049BB133111EBu;
        state[i] = z ^ (z >> 31);
    }
}

static double fresnel(double eta, double cosine) {
    double squared = 1 - eta * eta * (1 - cosine * cosine);
    if (squared <= 0) return 1;
    double onward = sqrt(squared);
    double across = (eta * cosine - onward) / (eta * cosine + onward);
    double along = (eta * onward - cosine) / (eta * onward + cosine);
    return 0.5 * (across * across + along * along);
}

int main(int count, char **words) {
    if (count != 7) return fprintf(stderr, "usage: walk PHOTONS SIGMA_A SIGMA_S G ETA THICKNESS\n"), 2;
    long photons = atol(words[1]), flights = 0;
    double sigma_a = atof(words[2]), sigma_s = atof(words[3]), g = atof(words[4]), eta = atof(words[5]), thickness = atof(words[6]);
    double left[2][RINGS + 1] = {{0}}, absorbed = 0, first = 0.02 / (sigma_a + sigma_s), growth = log(1e4) / (RINGS - 1);
    struct timespec begin, end;
    seed(2026);
    clock_gettime(CLOCK_MONOTONIC, &begin);
    for (long photon = 0; photon < photons; photon++) {
        double x = 0, y = 0, z = 0, ux = 0, uy = 0, uz = 1, carried = 1, to_scatter = -log(uniform());
        for (;;) {
            flights++;
            double scatter = to_scatter / sigma_s;
            double interface = uz < 0 ? -z / uz : uz > 0 ? (thickness - z) / uz : INFINITY;
            double length = scatter < interface ? scatter : interface;
            double kept = carried * exp(-sigma_a * length);
            absorbed += carried - kept;
            carried = kept;
            x += ux * length, y += uy * length, z += uz * length;
            if (scatter < interface) {
                double cosine = 2 * uniform() - 1;
                if (g != 0) {
                    double ratio = (1 - g * g) / (1 + g * cosine);
                    cosine = (1 + g * g - ratio * ratio) / (2 * g);
                }
                double sine = sqrt(1 - cosine * cosine), angle = 2 * M_PI * uniform();
                double along = sine * cos(angle), across = sine * sin(angle);
                if (g == 0) {
                    ux = along, uy = across, uz = cosine;
                } else {
                    double sign = copysign(1, uz), a = -1 / (sign + uz), b = ux * uy * a;
                    double vx = along * (1 + sign * ux * ux * a) + across * b + cosine * ux;
                    double vy = along * sign * b + across * (sign + uy * uy * a) + cosine * uy;
                    uz = -along * sign * ux - across * uy + cosine * uz, ux = vx, uy = vy;
                }
                to_scatter = -log(uniform());
            } else {
                to_scatter -= interface * sigma_s;
                z = uz > 0 ? thickness : 0;
                if (uniform() > fresnel(eta, fabs(uz))) {
                    double radius = sqrt(x * x + y * y);
                    int ring = radius < first ? 0 : 1 + (int)(log(radius / first) / growth);
                    left[uz > 0][ring < RINGS ? ring : RINGS] += carried;
                    break;
                }
                uz = -uz;
            }
            if (carried < 1e-4) {
                if (uniform() > 0.1) break;
                carried *= 10;
            }
        }
    }
    clock_gettime(CLOCK_MONOTONIC, &end);
    double total[2] = {0};
    for (int side = 0; side < 2; side++)
        for (int ring = 0; ring <= RINGS; ring++) total[side] += left[side][ring] / photons;
    printf("{\"reflectance\": %.6f, \"transmittance\": %.6f, \"absorbed\": %.6f, \"flights\": %.4f, \"seconds\": %.6f}\n", total[0],
           total[1], absorbed / photons, (double)flights / photons,
           (double)(end.tv_sec - begin.tv_sec) + 1e-9 * (double)(end.tv_nsec - begin.tv_nsec));
    return 0;
}
