/*
 * MATLAB gateway of a header that piezo_ident export wrote.
 *
 *     mex -R2018a stage_mex.c        beside stage.h
 *
 *     y = stage_mex(v)               displacement [m] under a voltage [V], from rest under v(1)
 *     v = stage_mex(y, true)         voltage for a wanted displacement; STAGE_PREVIEW samples ahead
 */
#include "mex.h"
#include "stage.h"

void mexFunction(int nlhs, mxArray *plhs[], int nrhs, const mxArray *prhs[])
{
    static stage_state model;
    static stage_feedforward drive;
    const double *in;
    double *out;
    size_t n, k;

    (void)nlhs;
    if (nrhs < 1 || nrhs > 2 || !mxIsDouble(prhs[0]) || mxIsComplex(prhs[0]))
        mexErrMsgIdAndTxt("stage:input", "give a real vector of double, and perhaps true");
    n = mxGetNumberOfElements(prhs[0]);
    plhs[0] = mxCreateDoubleMatrix(n, 1, mxREAL);
    if (n == 0)
        return;
    in = mxGetDoubles(prhs[0]);
    out = mxGetDoubles(plhs[0]);
    if (nrhs == 2 && mxIsLogicalScalarTrue(prhs[1])) {
        stage_feedforward_reset(&drive, in[0]);
        for (k = 0; k < n; k++)
            out[k] = stage_feedforward_step(&drive, in[k]);
    } else {
        stage_reset(&model, in[0]);
        for (k = 0; k < n; k++)
            out[k] = stage_step(&model, in[k]);
    }
}
