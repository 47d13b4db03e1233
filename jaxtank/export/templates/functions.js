function product(m, k, n, a, b) {
    const out = new Float64Array(m * n);
    for (let i = 0; i < m; ++i)
        for (let j = 0; j < n; ++j) {
            let s = 0;
            for (let l = 0; l < k; ++l) s += a[i * k + l] * b[l * n + j];
            out[i * n + j] = s;
        }
    return out;
}

function cholesky(n, a) {
    const out = new Float64Array(n * n);
    for (let j = 0; j < n; ++j)
        for (let i = j; i < n; ++i) {
            let s = a[i * n + j];
            for (let l = 0; l < j; ++l) s -= out[i * n + l] * out[j * n + l];
            out[i * n + j] = i === j ? Math.sqrt(s) : s / out[j * n + j];
        }
    return out;
}

function forward(n, k, a, b) {
    const out = new Float64Array(n * k);
    for (let c = 0; c < k; ++c)
        for (let i = 0; i < n; ++i) {
            let s = b[i * k + c];
            for (let l = 0; l < i; ++l) s -= a[i * n + l] * out[l * k + c];
            out[i * k + c] = s / a[i * n + i];
        }
    return out;
}

function backward(n, k, a, b) {
    const out = new Float64Array(n * k);
    for (let c = 0; c < k; ++c)
        for (let i = n - 1; i >= 0; --i) {
            let s = b[i * k + c];
            for (let l = i + 1; l < n; ++l) s -= a[l * n + i] * out[l * k + c];
            out[i * k + c] = s / a[i * n + i];
        }
    return out;
}

function solve(n, k, a, b) {
    const A = Float64Array.from(a), out = Float64Array.from(b);
    const swap = (v, i, j) => { const old = v[i]; v[i] = v[j]; v[j] = old; };
    for (let j = 0; j < n; ++j) {
        let best = j;
        for (let i = j + 1; i < n; ++i)
            if (Math.abs(A[i * n + j]) > Math.abs(A[best * n + j])) best = i;
        if (best !== j) {
            for (let l = 0; l < n; ++l) swap(A, j * n + l, best * n + l);
            for (let c = 0; c < k; ++c) swap(out, j * k + c, best * k + c);
        }
        for (let i = j + 1; i < n; ++i) {
            const f = A[i * n + j] / A[j * n + j];
            for (let l = j; l < n; ++l) A[i * n + l] -= f * A[j * n + l];
            for (let c = 0; c < k; ++c) out[i * k + c] -= f * out[j * k + c];
        }
    }
    for (let c = 0; c < k; ++c)
        for (let i = n - 1; i >= 0; --i) {
            let s = out[i * k + c];
            for (let l = i + 1; l < n; ++l) s -= A[i * n + l] * out[l * k + c];
            out[i * k + c] = s / A[i * n + i];
        }
    return out;
}

function rint(x) {
    const below = Math.floor(x), rest = x - below;
    return rest < 0.5 || (rest === 0.5 && below % 2 === 0) ? below : below + 1;
}
