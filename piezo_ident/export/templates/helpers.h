#ifndef PIEZO_IDENT_HELPERS
#define PIEZO_IDENT_HELPERS

/* x, or zero where it has died away */
static inline double piezo_alive(double x)
{
    return fabs(x) < {{ still }} ? 0.0 : x;
}

static inline double piezo_held(double f, double low, double high)
{
    f = f > high ? high : f;
    return f < low ? low : f;
}

static inline double piezo_curve(double c1, double c2, double c3, double width, double t)
{
    t = piezo_held(t, 0.0, width);
    return t * t * (c1 + t * (c2 + t * c3));
}

/*
 * Where f is `goal`, between low and high, for an f that rises; without such a place, the end that
 * comes nearest.  The search starts at x and widens by the error; then it is the secant of Illinois.
 */
static inline double piezo_root(double (*f)(const void *, double), const void *of, double goal,
                                double x, double low, double high)
{
    double fx, other, f_other, width;
    int i;
    x = piezo_held(x, low, high);
    fx = f(of, x) - goal;
    if (!(fabs(fx) > {{ tolerance }}))
        return x;
    width = -fx;
    for (;;) {
        other = piezo_held(x + width, low, high);
        if (other == x)
            return x;
        f_other = f(of, other) - goal;
        if (f_other * fx <= 0.0)
            break;
        x = other;
        fx = f_other;
        width *= 2.0;
    }
    /* `other` is the newer end */
    for (i = 0; i < {{ trials }} && fabs(f_other) > {{ tolerance }} && other != x; i++) {
        const double next = other - f_other * (other - x) / (f_other - fx);
        const double f_next = f(of, next) - goal;
        if (f_next * f_other < 0.0) {
            x = other;
            fx = f_other;
        } else {
            fx *= 0.5;
        }
        other = next;
        f_other = f_next;
    }
    return other;
}

#endif
