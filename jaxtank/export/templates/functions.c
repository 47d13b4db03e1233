static void product(int m, int k, int n, const real *a, const real *b, real *out)
{
    for (int i = 0; i < m; ++i)
        for (int j = 0; j < n; ++j) {
            real s = 0;
            for (int l = 0; l < k; ++l) s += a[i * k + l] * b[l * n + j];
            out[i * n + j] = s;
        }
}

static void cholesky(int n, const real *a, real *out)
{
    for (int j = 0; j < n; ++j)
        for (int i = 0; i < n; ++i) {
            real s = a[i * n + j];
            if (i < j) { out[i * n + j] = 0; continue; }
            for (int l = 0; l < j; ++l) s -= out[i * n + l] * out[j * n + l];
            out[i * n + j] = i == j ? SQRT(s) : s / out[j * n + j];
        }
}

static void forward(int n, int k, const real *a, const real *b, real *out)
{
    for (int c = 0; c < k; ++c)
        for (int i = 0; i < n; ++i) {
            real s = b[i * k + c];
            for (int l = 0; l < i; ++l) s -= a[i * n + l] * out[l * k + c];
            out[i * k + c] = s / a[i * n + i];
        }
}

static void backward(int n, int k, const real *a, const real *b, real *out)
{
    for (int c = 0; c < k; ++c)
        for (int i = n - 1; i >= 0; --i) {
            real s = b[i * k + c];
            for (int l = i + 1; l < n; ++l) s -= a[l * n + i] * out[l * k + c];
            out[i * k + c] = s / a[i * n + i];
        }
}

static void solve(int n, int k, const real *a, const real *b, real *out)
{
    real A[LARGEST];
    for (int i = 0; i < n * n; ++i) A[i] = a[i];
    for (int i = 0; i < n * k; ++i) out[i] = b[i];
    for (int j = 0; j < n; ++j) {
        int best = j;
        for (int i = j + 1; i < n; ++i)
            if (FABS(A[i * n + j]) > FABS(A[best * n + j])) best = i;
        for (int l = 0; l < n; ++l) {
            const real old = A[j * n + l];
            A[j * n + l] = A[best * n + l];
            A[best * n + l] = old;
        }
        for (int c = 0; c < k; ++c) {
            const real old = out[j * k + c];
            out[j * k + c] = out[best * k + c];
            out[best * k + c] = old;
        }
        for (int i = j + 1; i < n; ++i) {
            const real f = A[i * n + j] / A[j * n + j];
            for (int l = j; l < n; ++l) A[i * n + l] -= f * A[j * n + l];
            for (int c = 0; c < k; ++c) out[i * k + c] -= f * out[j * k + c];
        }
    }
    for (int c = 0; c < k; ++c)
        for (int i = n - 1; i >= 0; --i) {
            real s = out[i * k + c];
            for (int l = i + 1; l < n; ++l) s -= A[i * n + l] * out[l * k + c];
            out[i * k + c] = s / A[i * n + i];
        }
}
