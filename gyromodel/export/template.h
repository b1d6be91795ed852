/*
$about
*/
#ifndef GYROMODEL_COMPENSATE_H
#define GYROMODEL_COMPENSATE_H

#include <math.h>

/* One sample: the measured output and what the model needs besides. */
typedef struct {
$members
} gyromodel_sample;

/* The model: output at a rate (rad/s), and its derivative by the rate. */
static inline double gyromodel_output(const gyromodel_sample *x, double rate, double *slope)
{
$constants

    (void)x;
$statements
    *slope = $slope;
    return $output;
}

/* The rate itself where the output nowhere falls on the way from rest; else NaN: it lies on another branch. */
static inline double gyromodel_on_branch(const gyromodel_sample *x, double gain, double rate)
{
    int k;

    for (k = 1; k <= $waypoints; k++) {
        double slope;
        (void)gyromodel_output(x, rate * k / ($waypoints + 1), &slope);
        if (!(slope / gain > -$level))
            return NAN;
    }
    return rate;
}

/* The rate (rad/s) that gives the sample's output, on the branch through rest; NaN where there is none.
   Newton's method from output/gain, kept between the rates that are known to lie below and above the answer. */
static inline double gyromodel_rate(const gyromodel_sample *x)
{
    const double gain = $gain;
    const double target = x->$measured / gain;
    double rate = target, low = -INFINITY, high = INFINITY;
    int below = 0, above = 0, step;

    if (!isfinite(target))
        return NAN;
    for (step = 0; step < $steps; step++) {
        double slope;
        const double excess = gyromodel_output(x, rate, &slope) / gain - target;
        const int rising = slope / gain > -$level, steep = slope / gain > $level;
        const double far = copysign(fmax(fabs(excess), fabs(rate)), excess); /* twice as far out each time */
        const double newton = rate - (steep ? excess / (slope / gain) : excess == 0.0 ? 0.0 : far);
        const double size = $tolerance * (fabs(rate) + fabs(target));
        if (rising && excess < 0.0) {
            low = rate;
            below = 1;
        } else if (rising) {
            high = rate;
            above = 1;
        } else if (rate > 0.0) { /* beyond a fold: a wall */
            high = rate;
            above = 0;
        } else {
            low = rate;
            below = 0;
        }
        if (rising && fabs(newton - rate) <= size && (steep || fabs(excess) <= size))
            return gyromodel_on_branch(x, gain, newton);
        if (rising && newton > low && newton < high)
            rate = newton;
        else
            rate = isinf(low) || isinf(high) ? rate / 2.0 : (low + high) / 2.0;
        if (high - low <= size) /* the output jumps over the measured value, or never reaches it */
            return below && above ? gyromodel_on_branch(x, gain, rate) : NAN;
    }
    return NAN;
}

/* How many of some samples with known rates are not given back: zero. */
static inline int gyromodel_self_test(void)
{
    static const struct {
        gyromodel_sample sample;
        double rate;
    } tests[] = {
$tests
    };
    int failed = 0, k;

    for (k = 0; k < (int)(sizeof tests / sizeof tests[0]); k++) {
        const double error = gyromodel_rate(&tests[k].sample) - tests[k].rate;
        failed += !(fabs(error) <= 1e-8 * (1.0 + fabs(tests[k].rate)));
    }
    return failed;
}

#endif
