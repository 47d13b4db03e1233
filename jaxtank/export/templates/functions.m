function out = product_(m, k, n, a, b)
    c = reshape(b, n, k) * reshape(a, k, m);
    out = c(:).';
end

function out = cholesky_(n, a)
    c = chol(reshape(a, n, n));
    out = c(:).';
end

function out = forward_(n, k, a, b)
    c = (reshape(a, n, n).' \ reshape(b, k, n).').';
    out = c(:).';
end

function out = backward_(n, k, a, b)
    c = (reshape(a, n, n) \ reshape(b, k, n).').';
    out = c(:).';
end

function out = solve_(n, k, a, b)
    c = (reshape(a, n, n).' \ reshape(b, k, n).').';
    out = c(:).';
end

function out = pick(condition, yes, no)
    if condition
        out = yes;
    else
        out = no;
    end
end
